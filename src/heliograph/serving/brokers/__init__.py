"""Transports: pipes, MQTT, NATS, and what each must do."""
