"""LLVM IR: a program as text, and as code of this machine."""
