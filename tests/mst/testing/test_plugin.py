"""The package of the documentation: if it is installed, its component has a name."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib

from tests.conftest import REPOSITORY


def test_components_of_an_installed_package_have_a_name(tmp_path):
    page = (REPOSITORY / "docs" / "components.md").read_text()
    blocks = re.findall(r"```(?:python|{code-cell})\n(.*?)```", page, flags=re.DOTALL)
    top = next(b for b in blocks if "class Top(" in b)
    project = tomllib.loads(
        next(b for b in re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL) if "[project]" in b)
    )
    (tmp_path / "top_resampler.py").write_text(top)
    # What an installation leaves: the names under which the package is found.
    info = tmp_path / "top_resampler-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: top-resampler\nVersion: 1.0\n")
    ((group, names),) = project["project"]["entry-points"].items()
    lines = "\n".join(f"{name} = {where}" for name, where in names.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}\n")

    def call(*arguments):
        environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{REPOSITORY}"}
        done = subprocess.run(
            [sys.executable, "-m", *arguments],
            capture_output=True,
            text=True,
            timeout=600,
            env=environment,
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert "Keep the best" in call("mstfilter", "list", "resampler")
    assert "Top: all properties that apply hold" in call("mstfilter", "check", "resampler.top")
