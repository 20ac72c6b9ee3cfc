"""README and pages: every shell block is run here, or says who runs it; every link and every option exists.

Marks: `test: NAME` is run by a test as it stands, `ros` too where there is ROS 2 (integration/test_ros2_pages.py); of
`terminals` each line is a process that a test starts (integration/test_node_processes.py, test_connecting.py,
demo/test_demo.py); `install` is the CI step itself, from a bare checkout, `ros install` that of a workspace.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from octn_ros.cli import main

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
MARKED = [
    REPOSITORY / name
    for name in ("README.md", "docs/connecting.md", "docs/troubleshooting.md", "docs/security.md")
]  # fmt: skip
RUN_BY = re.compile(r"test: \w+|ros|terminals|install|ros install")
SMALL_SCAN = "make_phantom(PhantomConfig(shape=(16, 48, 40), wave_amplitude_m=20e-6))"


@pytest.mark.parametrize("page", MARKED, ids=lambda page: page.stem)
def test_every_block_says_who_runs_it(shell_blocks: Callable[..., Any], page: Path) -> None:
    for mark, block in shell_blocks(page):
        assert RUN_BY.fullmatch(mark), f"{page.name}: a shell block without a mark:\n{block}"
    # An indented block would slip past; README and these pages have none.
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not re.findall(r"\n\n {4}(?:octn|ros2|make|pip|python|\.venv) .*", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_link_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http:", "https:", "mailto:")):
            assert (page.parent / target).exists(), target


@pytest.mark.timeout(300)
def test_the_step_by_step_block_runs_as_it_stands(
    shell_blocks: Callable[..., Any], shell_commands: Callable[..., Any], tmp_path: Path
) -> None:
    """All of it, in the shell, in a folder of its own; only the phantom is a small one and the fit a short one."""
    (block,) = [text for mark, text in shell_blocks(REPOSITORY / "README.md") if mark == "test: steps"]
    small = block.replace("make_phantom()", SMALL_SCAN).replace("import make", "import PhantomConfig, make")
    assert small != block
    lines = [line for line in shell_commands(small) if "activate" not in line and "--device cuda" not in line]
    assert len(lines) >= 8
    fit = [number for number, line in enumerate(lines) if line.startswith("octn fit")]
    assert fit
    for number in fit:
        lines[number] = lines[number].partition("#")[0] + " --time-budget-s 3"
    folder = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"}
    script = "\n".join([f"ln -s {shlex.quote(str(REPOSITORY / 'config'))} config", *lines])
    ended = subprocess.run(
        ["bash", "-euxc", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    for name in ("field.safetensors", "cut.png", "surface.ply", "plan.json"):
        assert (tmp_path / name).stat().st_size > 100, name


def test_the_commands_of_octn_in_all_blocks_have_the_options_they_are_shown_with(
    capsys: pytest.CaptureFixture[str],
) -> None:
    helped: dict[str, str] = {}
    seen = 0
    for page in PAGES:
        for line in re.findall(r"^\s*(?:\.venv/bin/)?octn ([^\n#]*)", page.read_text(encoding="utf-8"), re.MULTILINE):
            words = line.split()
            if not words or not re.fullmatch(r"[a-z]+", words[0]) or words[0] == "run":
                continue
            name = words[0]
            if name not in helped:
                with contextlib.suppress(SystemExit):
                    main([name, "--help"])
                helped[name] = capsys.readouterr().out
            for option in re.findall(r"(?<!\S)--[a-z][\w-]*", line):
                assert option in helped[name], f"{page.name}: octn {line}"
                seen += 1
    assert seen > 10


def test_readme_names_the_default_region_of_a_plan() -> None:
    from octn_ros.planning import RegionConfig

    width, length = (side * 1e3 for side in RegionConfig().size_m)
    words = " ".join((REPOSITORY / "README.md").read_text(encoding="utf-8").split())
    assert f"{width:g} x {length:g} mm about the middle of the scan" in words
