"""Completion: from the visible part of an object to the space it fills (paper IV-B)."""
