"""Measurements that the pages of the documentation rest on, a program each."""
