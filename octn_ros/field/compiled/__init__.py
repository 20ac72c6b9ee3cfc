"""Compiled evaluation of neural fields on the CPU, through numba.

Nothing is imported here: numba loads and compiles only when a field is first asked through this back end.
"""
