"""Filters of senders that decide when to send."""
