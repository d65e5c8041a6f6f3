"""Starting files for components of your own: ``mstfilter new resampler mine.py`` copies one, with its test."""
