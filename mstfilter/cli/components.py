"""Commands about components: list, check, new."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mstfilter.cli.root import app
from mstfilter.errors import InputError


@app.command("list")
def list_(
    kind: Annotated[str, typer.Argument(help="One kind only: resampler, rule, ..., presets or families.")] = "",
) -> None:
    """List presets, scene families and components with their fields."""
    from mstfilter.cli.listing import print_list

    print_list(kind)


@app.command()
def check(
    component: Annotated[str, typer.Argument(help="./file.py:Class, or KIND.NAME such as resampler.systematic.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[FIELD=VALUE]...", help="Values of fields.")
    ] = None,
) -> None:
    """Test whether a component keeps the contract of its interface."""
    from mstfilter.presets import REGISTRY, settings
    from mstfilter.smc.testing import FALSE_ALARM
    from mstfilter.testing import run_contract

    kind, _, name = ("", "", component) if ".py:" in component else component.partition(".")
    if ".py:" not in component and kind not in REGISTRY.kinds:
        raise InputError(
            f"{component!r} is no component", "give ./file.py:Class, or KIND.NAME as `mstfilter list` shows"
        )
    cls = REGISTRY.find_class(kind, name, component, allow_files=True)
    results = run_contract(REGISTRY.make(cls, settings(overrides or ()), allow_files=True))
    for result in results:
        state = "broken" if result.failure else "skipped" if result.skipped else "holds"
        print(f"{state:<9}{result.statement}")
        if result.failure or result.skipped:
            print(f"{'':<9}  {result.failure or result.skipped}  [{result.name}]")
    statistical = sum(result.statistical and not result.skipped for result in results)
    if statistical:
        print(f"{statistical} of these are statistical, each with a false-alarm rate of at most {FALSE_ALARM:.0e}")
    broken = sum(result.failure is not None for result in results)
    verdict = f"{broken} {'property is' if broken == 1 else 'properties are'} broken"
    print(f"{cls.__name__}: {verdict if broken else 'all properties that apply hold'}")
    if broken:
        raise typer.Exit(1)


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
    from mstfilter.testing import write_starter

    commands = write_starter(kind, path, target)
    print(f"component   {path}")
    if any("demo/recording" in command for command in commands) and not Path("demo/recording").exists():
        print("first       mstfilter demo")
    for command in commands:
        print(f"next        {command}")
