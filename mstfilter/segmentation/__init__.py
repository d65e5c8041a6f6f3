"""Segmentation: image -> boundaries -> tree -> cuts -> hypotheses (paper IV-B)."""
