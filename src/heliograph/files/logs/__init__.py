"""Logs as vehicles record them: frames of a CAN bus by a database, signals of MDF4, topics of ULog."""
