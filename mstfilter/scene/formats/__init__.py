"""Recordings on disk: our own folder, and adapters for other layouts."""
