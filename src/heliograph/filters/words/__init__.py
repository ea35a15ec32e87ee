"""Filters of words of finite length."""
