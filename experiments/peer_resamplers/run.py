"""Which properties do the resamplers of other libraries have?

    python experiments/peer_resamplers/run.py [--only filterpy] [--smoke] [--out DIR]

`table.csv`: every test of the contract of resamplers, and every direct call (direct.py), with every scheme of every
installed library. `filters.csv`: a bootstrap filter with each scheme, against the exact evidence. Each test runs in a
process that may die; a row says so.
"""

from __future__ import annotations

import argparse
import inspect
import json
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any
from unittest import SkipTest

import numpy as np
from adapters import ADAPTERS, Adapter, installed
from direct import TESTS

from mstfilter.files import read_csv, write_csv
from mstfilter.smc import (
    Always,
    Multinomial,
    Residual,
    Stratified,
    Systematic,
    WeightResampler,
    bootstrap,
    linear_gaussian,
    log_evidence,
    run_many,
)
from mstfilter.testing import contract_of

HERE = Path(__file__).resolve().parent
FIELDS = ("library", "version", "scheme", "kind", "test", "property", "outcome", "why")
#: Tests of the small form.
SMOKE = ("gives_n_particles", "carried_weight", "any_size", "nan")
#: Seconds of processor time of one test.
LIMIT = 120
PACKAGES = tuple(dict.fromkeys(adapter.package for adapter in ADAPTERS))


def contract_tests(adapter: Adapter) -> dict[str, Any]:
    """The tests of the contract of an adapter, by name."""
    contract = contract_of(type(adapter))
    methods = {name: method for cls in reversed(contract.__mro__) for name, method in vars(cls).items()}
    return {name.removeprefix("test_"): method for name, method in methods.items() if name.startswith("test_")}


def tested(adapter: Adapter, kind: str, test: str) -> dict[str, str]:
    """Outcome of one test in this process."""
    if kind == "contract":
        cls = type("Test", (contract_of(type(adapter)),), {"make": lambda self: adapter})
        instance = cls()
        call = getattr(instance, f"test_{test}")
    else:
        instance, call = None, lambda: TESTS[test](adapter)
    try:
        if instance is not None:
            instance.setup_method()
        call()
    except SkipTest as skipped:
        return {"outcome": "not tested", "why": str(skipped)}
    except Exception as error:
        message = str(error) if isinstance(error, AssertionError) else f"{type(error).__name__}: {error}"
        message = " ".join(message.split())[:400]
        return {"outcome": "error" if re.search(r"[A-Z]\w*Error: ", message) else "wrong", "why": message}
    finally:
        if instance is not None:
            instance.teardown_method()
    return {"outcome": "holds", "why": ""}


def worker() -> None:
    """Run tests that standard input names as [number of adapter, kind, test]."""
    warnings.simplefilter("ignore")
    for line in sys.stdin:
        number, kind, test = json.loads(line)
        signal.setitimer(signal.ITIMER_PROF, LIMIT)  # its signal ends the process, also in compiled code
        answer = tested(ADAPTERS[number], kind, test)
        signal.setitimer(signal.ITIMER_PROF, 0)
        print(json.dumps(answer), flush=True)


class Worker:
    """A process that runs tests, and is started again when it dies."""

    process: subprocess.Popen[str] | None = None

    def run(self, *task: Any) -> dict[str, str]:
        """Outcome of one test."""
        if self.process is None:
            command = [sys.executable, __file__, "--worker"]
            self.process = subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.process.stdin.write(json.dumps(task) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if answer:
            return json.loads(answer)
        status = -self.process.wait()
        self.close()
        if status == signal.SIGPROF:
            return {"outcome": "too slow", "why": f"takes more than {LIMIT} s"}
        return {"outcome": "process dies", "why": f"the process ends with {signal.Signals(status).name}"}

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.stdin.close()
            self.process.wait()
            self.process.stdout.close()
            self.process = None


def table(chosen: list[Adapter], smoke: bool) -> list[dict[str, str]]:
    """Outcomes of all tests of some adapters."""
    rows, process = [], Worker()
    for adapter in chosen:
        tests = {("contract", name): method for name, method in contract_tests(adapter).items()}
        tests |= {("direct call", name): function for name, function in TESTS.items()}
        if smoke:
            tests = {key: function for key, function in tests.items() if key[1] in SMOKE}
        for (kind, name), function in tests.items():
            found = process.run(ADAPTERS.index(adapter), kind, name)
            about = (adapter.package, installed(adapter.package), adapter.scheme, kind, name)
            statement = (inspect.getdoc(function) or name).split("\n")[0]
            rows.append(dict(zip(FIELDS, (*about, statement, found["outcome"], found["why"]), strict=True)))
        mine = [r for r in rows if (r["library"], r["scheme"]) == (adapter.package, adapter.scheme)]
        broken = [r["test"] for r in mine if r["outcome"] not in ("holds", "not tested")]
        print(f"{adapter.package} {adapter.scheme}: {len(broken)} of {len(mine)}: {', '.join(broken)}", flush=True)
    process.close()
    return rows


def exact_log_evidence(ys: np.ndarray) -> float:
    """Of x_0 ~ N(0, 1), x_t = .9 x_{t-1} + N(0, .6^2), y_t = x_t + N(0, .4^2), by the Kalman filter of filterpy."""
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=1, dim_z=1)
    kalman.x, kalman.P = np.zeros((1, 1)), np.eye(1)
    kalman.F, kalman.H = np.array([[0.9]]), np.eye(1)
    kalman.Q, kalman.R = np.array([[0.36]]), np.array([[0.16]])
    total = 0.0
    for t, y in enumerate(ys):
        if t:
            kalman.predict()
        kalman.update(y)
        total += kalman.log_likelihood
    return float(total)


def filters(chosen: list[Adapter], seeds: int, steps: int = 25, n: int = 200) -> list[dict[str, Any]]:
    """Bootstrap filters with each scheme, and with schemes of mstfilter; the data and seeds are the same."""
    model = linear_gaussian(*np.array([[[0.9]], [[0.36]], [[1.0]], [[0.16]]]), [0.0], [[1.0]])
    rng, ys, x = np.random.default_rng(3), [], 0.0
    for t in range(steps):
        x = 0.9 * x + 0.6 * rng.standard_normal() if t else rng.standard_normal()
        ys.append(np.array([x + 0.4 * rng.standard_normal()]))
    schemes: dict[tuple[str, str], WeightResampler] = {
        ("mstfilter", type(s).__name__.lower()): s for s in (Multinomial(), Residual(), Stratified(), Systematic())
    }
    schemes |= {(adapter.package, adapter.scheme): adapter for adapter in chosen}
    exact, rows = exact_log_evidence(np.ravel(ys)), []
    for (library, scheme), resampler in schemes.items():
        runs = run_many(
            {scheme: bootstrap(model, n, resampler, Always())}, ys, range(seeds), log_evidence=log_evidence
        )
        errors = runs["log_evidence"][0, :, -1] - exact
        ratio, kept = np.exp(errors), errors[np.isfinite(errors)]
        rows.append(
            {
                "library": library,
                "scheme": scheme,
                "runs": seeds,
                "lost": len(runs.lost),
                "mean_evidence_ratio": f"{ratio.mean():.4f}",
                "standard_error": f"{ratio.std(ddof=1) / np.sqrt(seeds):.4f}",
                "sd_log_evidence": f"{kept.std(ddof=1):.4f}" if len(kept) > 1 else "",
            }
        )
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Test the installed libraries."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="residual schemes, four tests, few runs; needs --out")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--only", choices=PACKAGES, help="one library; rows of the others are kept")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker()
        return
    if options.smoke and options.out == HERE / "results":
        parser.error("--smoke would overwrite the results: name another folder with --out")
    wanted = [options.only] if options.only else PACKAGES
    missing = [package for package in wanted if installed(package) is None]
    if missing:
        print("not installed:", ", ".join(missing))
    chosen = [a for a in ADAPTERS if a.package in wanted and a.package not in missing]
    if options.smoke:
        chosen = [a for a in chosen if a.scheme == "residual"]
    packages = {a.package for a in chosen}
    found = {"table.csv": table(chosen, options.smoke), "filters.csv": filters(chosen, 10 if options.smoke else 500)}
    for name, rows in found.items():
        path = options.out / name
        kept = [r for r in read_csv(path) if r["library"] not in packages | {"mstfilter"}] if path.exists() else []
        write_csv(path, sorted([*rows, *kept], key=lambda r: r["library"]))


if __name__ == "__main__":
    main()
