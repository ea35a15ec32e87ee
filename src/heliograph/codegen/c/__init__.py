"""C99: a program as source text."""
