"""Messages in files, and the events they are read as."""
