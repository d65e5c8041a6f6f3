"""Figures like those of the paper, drawn from simulated scenes and the authors' data.

    python experiments/paper_figures/make.py                       # all, about a quarter of an hour
    python experiments/paper_figures/make.py merging sampled_cuts  # some figures, by name
    python experiments/paper_figures/make.py quality_over_time --study studies/main
    python experiments/paper_figures/make.py --smoke --out DIR     # all at small size, a minute

`merging` needs the authors' particles (r1.py); if they are missing, the script prints a message and skips the figure.
`quality_over_time` needs the folder of a study.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

import matplotlib.style

from mstfilter.base.errors import InputError

FIGURES = (
    "merging",
    "teaser",
    "sampled_cuts",
    "quality_over_time",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=f"{', '.join(FIGURES)}; default: all")
    parser.add_argument(
        "--smoke", action="store_true", help="small and quick; shows only that all works; needs --out"
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "results")
    parser.add_argument("--study", type=Path, help="folder of a study, for quality_over_time")
    parser.add_argument("--arms", default="", help="the arms of the study to draw, by comma; default: all compared")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    unknown = [name for name in options.figures if name not in FIGURES]
    if unknown:
        parser.error(f"no figure is called {unknown[0]!r}; there are {', '.join(FIGURES)}")
    arms = [name.strip() for name in options.arms.split(",") if name.strip()]
    with (
        matplotlib.style.context("mstfilter.app.report.figures"),
        matplotlib.rc_context({"svg.hashsalt": "mstfilter"}),
    ):
        for name in options.figures or FIGURES:
            figure = importlib.import_module(name)
            if name == "quality_over_time":
                try:
                    made = figure.make(options.out, options.study, arms) if options.study else []
                except InputError as error:
                    parser.error("; ".join((error.message, *error.hints)))
                missing = "give a study with --study"
            else:
                made, missing = figure.make(options.out, options.smoke), "the authors' particles are absent"
            print(f"{name}:", ", ".join(map(str, made)) or f"left out, {missing}", flush=True)


if __name__ == "__main__":
    main()
