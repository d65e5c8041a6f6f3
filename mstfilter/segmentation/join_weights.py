"""Weights of `joins.FEATURES`: log odds that two regions are different objects.

Fitted on simulated scenes by

    python experiments/segmentation_fit/run.py

which writes this table; no real image was used.
"""

JOIN_WEIGHTS: dict[str, float] = {
    "bias": -11.37,
    "strength": 3.39,
    "strength^2": -9.611,
    "hollow": 7.277,
    "convex": -0.6699,
    "step": 2.463,
    "clear step share": -0.301,
    "lightness": -0.7733,
    "chroma": 1.093,
    "texture": 0.6076,
    "misfit": 0.5415,
    "residual": -0.4111,
    "border share": -8.262,
    "free border share": -0.3599,
    "log pixels": 0.6314,
    "log ratio": 0.6477,
    "front higher": 1.738,
    "back higher": 0.01584,
    "front bottom": -0.2304,
    "back bottom": -0.03871,
    "front bend": 2.408,
    "back bend": -0.4138,
    "ground distance": -0.0927,
    "front on table": 0.3469,
    "back on table": -1.229,
    "front drop": -0.778,
    "back drop": -0.06153,
    "rim": -0.04713,
    "rim * back bend": -6.006,
    "rim * step": -0.2294,
    "rim * inside": -4.628,
    "step * misfit": -0.263,
    "hollow * misfit": -0.4426,
    "strength * log pixels": -1.552,
    "hollow * log pixels": 3.143,
    "convex * strength": -4.363,
}
