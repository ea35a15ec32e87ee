"""Models made of models: plants and sensors with further states, and sensors of several nodes as one."""
