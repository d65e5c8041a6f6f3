"""What all rooms share: errors, checks of fields, files, processes, lazy imports, and the registry of components.

Nothing here knows about particles or images.
"""
