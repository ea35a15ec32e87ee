"""Text in files and pipes: packed or not, in which Unicode, and tables of CSV a line at a time."""
