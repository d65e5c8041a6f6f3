"""Commands about components: list, check, new."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from mstfilter.app.cli.root import app
from mstfilter.base.errors import InputError


@app.command("list")
def list_(
    kind: Annotated[str, typer.Argument(help="One kind only: resampler, rule, ..., presets or families.")] = "",
) -> None:
    """List presets, scene families and components with their fields."""
    from mstfilter.app.cli.listing import print_list

    print_list(kind)


@app.command()
def check(
    component: Annotated[
        str, typer.Argument(help="./file.py:Class, ./file.py:model, or KIND.NAME such as resampler.systematic.")
    ],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[FIELD=VALUE]...", help="Values of fields.")
    ] = None,
    budget: Annotated[
        float, typer.Option(min=1, metavar="SECONDS", help="Time for all properties. The rest is not tested.")
    ] = 120,
    observations: Annotated[
        str, typer.Option(metavar="FILE.npy|./FILE.py:NAME", help="Of a model. Default: drawn from the model.")
    ] = "",
) -> None:
    """Test whether a component keeps the contract of its interface, or whether a model is one for a filter."""
    from mstfilter.mst.testing import check_of, is_model, run_contract
    from mstfilter.smc.testing import FALSE_ALARM, CheckResult

    subject = _subject(component, overrides or [])
    if getattr(subject, "of_one_recording", False):
        raise InputError(
            f"{component} reads the files of one recording, which the scenes of the test do not have",
            "`mstfilter run RECORDING` with it checks the files of all pauses before it starts",
        )
    name = component if is_model(subject) else type(subject).__name__
    if observations and not is_model(subject):
        raise InputError(f"observations are given, and {component} is no model", "leave --observations out")
    print(f"{'input':<9}{check_of(subject).input}", flush=True)

    def show(result: CheckResult) -> None:
        state = "broken" if result.failure else "skipped" if result.skipped else "holds"
        print(f"{'untested' if result.out_of_time else state:<9}{result.statement}")
        for line in filter(None, (result.failure or result.skipped, result.remark)):
            print(f"{'':<9}  {line}  [{result.name}]")
        sys.stdout.flush()

    ys = _observations(observations) if observations else None
    results = run_contract(subject, budget=budget, progress=show, observations=ys)
    statistical = sum(result.statistical and not result.skipped for result in results)
    if statistical:
        print(f"{statistical} of these are statistical, each with a false-alarm rate of at most {FALSE_ALARM:.0e}")
    broken, late = (
        sum(map(bool, states)) for states in zip(*((r.failure, r.out_of_time) for r in results), strict=True)
    )
    verdict = f"{broken} {'property is' if broken == 1 else 'properties are'} broken"
    untested = f"{late} {'is' if late == 1 else 'are'} not tested in {budget:g} s (--budget)" if late else ""
    if not broken:
        verdict = "no tested property is broken" if late else "all properties that apply hold"
    print(f"{name}: {', '.join(filter(None, (verdict, untested)))}")
    if broken:
        raise typer.Exit(1)


def _subject(name: str, overrides: list[str]) -> Any:
    """What `check` tests: the component with the given fields, or the model of a file."""
    from mstfilter.base.user_files import load_attribute
    from mstfilter.mst.testing import is_model
    from mstfilter.runs.presets import REGISTRY, settings

    if ".py:" in name and is_model(found := load_attribute(name)):
        if overrides:
            raise InputError(f"{name} is a model, which has no fields to set: {overrides[0]}")
        return found
    kind, _, known = ("", "", name) if ".py:" in name else name.partition(".")
    if ".py:" not in name and kind not in REGISTRY.kinds:
        raise InputError(f"{name!r} is no component", "give ./file.py:Class, or KIND.NAME as `mstfilter list` shows")
    cls = REGISTRY.find_class(kind, known, name, allow_files=True)
    if not dataclasses.is_dataclass(cls) and not overrides and not inspect.isabstract(cls):
        try:
            return cls()
        except TypeError as error:
            raise InputError(
                f"{cls.__name__} cannot be made without arguments: {error}", "give its fields defaults"
            ) from error
    return REGISTRY.make(cls, settings(overrides), allow_files=True)


def _observations(name: str) -> list[Any]:
    """The observations of a run, from an .npy file or a sequence in a Python file."""
    from mstfilter.base.user_files import load_attribute
    from mstfilter.smc.inputs import check_observations

    if ".py:" in name:
        return list(check_observations(load_attribute(name)))
    import numpy as np

    try:
        return list(check_observations(np.load(name, allow_pickle=False)))
    except (OSError, ValueError) as error:
        raise InputError(
            f"observations {name}: {error}", "np.save writes an array with one row for each step"
        ) from error


@app.command()
def new(
    kind: Annotated[
        str, typer.Argument(help="transition, proposal, update, evidence, resampler, ...; a wrong one lists all.")
    ],
    path: Annotated[Path, typer.Argument(help="Python file to write, for example mine.py.")],
    target: Annotated[
        str, typer.Option("--for", metavar="scenes|numbers", help="What the particles are. Default: scenes.")
    ] = "",
) -> None:
    """Write a working component with comments, to be changed by the user."""
    from mstfilter.mst.testing import write_starter

    commands = write_starter(kind, path, target)
    print(f"component   {path}")
    missing = not Path("demo/recording").exists()
    for command in commands:
        if missing and "demo/recording" in command:
            print("next        mstfilter demo      # makes the recording of the next command")
            missing = False
        print(f"next        {command}")
