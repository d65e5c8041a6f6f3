"""Scenes for tuning and for reporting share no size, no hue and no name."""

import colorsys
from dataclasses import replace

import numpy as np
import pytest

from mstfilter.simulation import printing
from mstfilter.simulation.arrangement import draw_objects
from mstfilter.simulation.families import scene_family
from mstfilter.simulation.shapes import ANY, REPORTED, TUNING

POOLS = (TUNING, REPORTED)


@pytest.mark.parametrize(("draw", "whole"), [("factor", (0.9, 1.1)), ("hue", (0.0, 1.0))])
def test_bands_are_apart_and_cover_the_same_range(draw, whole):
    rng = np.random.default_rng(0)
    first, second = (np.sort([getattr(pool, draw)(rng) for _ in range(3000)]) for pool in POOLS)
    step = np.searchsorted(first, second)
    near = np.minimum(np.abs(second - first[np.minimum(step, 2999)]), np.abs(second - first[np.maximum(step - 1, 0)]))
    assert near.min() > 0.0015
    for values in (first, second, np.sort([getattr(ANY, draw)(rng) for _ in range(3000)])):
        assert values[0] >= whole[0] and values[-1] <= whole[1]
        # Six deviations of the mean of a uniform variable.
        assert abs(values.mean() - np.mean(whole)) < 0.05 * np.diff(whole)[0] + 6 * np.diff(whole)[0] / 12**0.5 / 54


def test_names_are_apart():
    rng = np.random.default_rng(0)
    first, second = ({word for _ in range(200) for word in printing.brand(rng, pool)} for pool in POOLS)
    assert len(first) > 20 and len(second) > 20 and not first & second


def test_colours_are_apart():
    rng = np.random.default_rng(0)
    for pool in POOLS:
        for _ in range(300):
            r, g, b = printing.shade(rng, (0.8, 0.9), 0.5, pool)
            hue, saturation, _ = colorsys.rgb_to_hsv(r / 255, g / 255, b / 255)
            if saturation > 0.3:
                # Colours are whole numbers: the hue is known to about 0.004.
                assert (int((hue + 0.004) * 12) % 2 == pool.half) or (int((hue - 0.004) * 12) % 2 == pool.half)


def test_scenes_of_both_sides_share_no_measure():
    # Seeds from 5000 on stand for the reported side: those of the reports are not looked at.
    def measures(seeds):
        found = set()
        for seed in seeds:
            family = replace(scene_family("s3"), shapes="can").for_seed(seed)
            for shape in draw_objects(np.random.default_rng(seed), family).shapes:
                nominal = {"soup": 0.033, "coffee": 0.051, "tuna": 0.0425, "crisps": 0.0375, "biscuits": 0.075}
                found.add(int((shape.half[0] / nominal[shape.name] - 0.9) / 0.025))
        return found

    tuning, reported = measures((0, 1)), measures((5000, 5001))
    assert tuning <= {0, 3, 4, 7} and reported <= {1, 2, 5, 6}
