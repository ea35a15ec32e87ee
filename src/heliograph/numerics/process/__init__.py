"""The process that computes: its garbage collector, its stack, signals to it, and packages that it may lack."""
