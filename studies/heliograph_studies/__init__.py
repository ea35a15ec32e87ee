"""Studies made of the library's public parts: publications reproduced and examples, each in a folder of its own.

`heliograph reproduce` and `heliograph example` list and run them; in Python each is a module with `Setting` and `run`.
"""
