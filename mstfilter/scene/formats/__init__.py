"""Recordings on disk: our own folder, and one reader for each other layout.

A reader is a `Format`: a frozen dataclass with ``detects(path)`` and ``open(path)``. What they share stands in
`mstfilter.scene.formats.video`, how a long video is cut at its pauses in `mstfilter.scene.formats.pauses`.
"""
