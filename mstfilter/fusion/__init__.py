"""Predicted x proposed -> fused hypotheses: the measurement update of MST (paper, section IV-D)."""
