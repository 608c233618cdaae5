"""README and guide say what is true: commands and flags that exist, every verdict, every effect, pages that link."""

from __future__ import annotations

import base64
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import get_args

import nbformat
import pytest
import typer
from nbclient import NotebookClient
from nbformat import NotebookNode
from nbformat.v4 import new_output

import sysid_btr
from sysid_btr.cli import app
from sysid_btr.diagnosis.closing import Verdict
from sysid_btr.terms.library import effect_names

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]


@pytest.fixture(scope="module")
def build() -> ModuleType:
    """The generator of the documentation."""
    pytest.importorskip("pdoc", reason="the documentation needs the extra `dev`")
    spec = spec_from_file_location("docs_build", ROOT / "docs" / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules["docs_build"] = module
    spec.loader.exec_module(module)
    return module


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Verb and flags of every command line on a page."""
    for text in re.findall(r"sysid-btr ([a-z]+[^\n`#]*)", page.read_text(encoding="utf-8")):
        words = shlex.split(text.replace("'", '"') if text.count("'") % 2 else text)
        yield words[0], [w.partition("=")[0] for w in words[1:] if w.startswith("--")]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_command_of_a_page_exists(page: Path) -> None:
    verbs = typer.main.get_command(app).commands
    found = list(commands(page))
    assert found or page.name in ("limits.md", "architecture.md")
    for verb, flags in found:
        assert verb in verbs
        known = {option for parameter in verbs[verb].params for option in parameter.opts} | {"--help"}
        assert set(flags) <= known, (page.name, verb, flags)


def test_the_picture_of_the_rooms_is_the_order_that_is_checked() -> None:
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    page = (ROOT / "docs" / "guide" / "architecture.md").read_text()
    rows = [re.split(r"\s{2,}", row.strip())[0] for row in re.findall(r"^    \S.*$", page, re.MULTILINE)]
    assert rows == contract["layers"]


def test_what_the_architecture_speaks_of_exists() -> None:
    page = (ROOT / "docs" / "guide" / "architecture.md").read_text()
    files = list((ROOT / "sysid_btr").rglob("*.py"))
    code = "\n".join(file.read_text() for file in files)
    spoken = re.findall(r"`([^`]+)`", page.replace("\n", " "))
    for path in (s for s in spoken if s.endswith(".py")):
        assert any(file.as_posix().endswith(f"/{path}") for file in (*files, *(ROOT / "tests").glob("*.py"))), path
    for name in {s.partition("(")[0].rpartition(".")[2] for s in spoken if re.fullmatch(r"[\w.]+(\(.*\))?", s)}:
        assert re.search(rf"\b{name}\b", code), name


def test_every_name_of_the_package_that_a_page_uses_exists() -> None:
    for page in PAGES:
        for name in re.findall(r"\bsb\.([a-z_]+)", page.read_text(encoding="utf-8")):
            assert name in sysid_btr.__all__, (page.name, name)


def test_every_verdict_is_explained() -> None:
    text = (ROOT / "docs" / "guide" / "verdicts.md").read_text(encoding="utf-8")
    for verdict in get_args(Verdict):
        assert f"## `{verdict}`" in text


def test_pages_made_from_code_hold_all_of_it(build: ModuleType) -> None:
    effects, verbs = build.effects_page(), build.commands_page()
    for name in effect_names():
        assert f"| `{name}` |" in effects
    for verb in typer.main.get_command(app).commands:
        assert f"## {verb}\n" in verbs
    reference = build.reference_page()
    for name in sysid_btr.__all__:
        assert f"`sb.{name}`" in reference


def test_pages_link_to_pages(build: ModuleType, tmp_path: Path) -> None:
    for name, title in build.TITLES.items():
        if name not in build.PAGES:
            text = (ROOT / "docs" / "guide" / f"{name}.md").read_text(encoding="utf-8")
            (tmp_path / f"{name}.html").write_text(build.page(name, title, text))
        else:
            (tmp_path / f"{name}.html").touch()
    assert {b for b in build.broken_links(tmp_path) if "api/" not in b} == set()
    (tmp_path / "limits.html").unlink()
    assert "index.html: limits.html" in set(build.broken_links(tmp_path))


FIGURE = base64.b64encode(b"\x89PNG\r\n\x1a\n").decode()


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_every_notebook_has_a_page_with_its_figures(build: ModuleType, tmp_path: Path, path: Path) -> None:
    pytest.importorskip("nbconvert", reason="the documentation needs the extra `dev`")
    notebook = as_executed(build, path)
    figures = sum(build.draws(source) for source in build.code(notebook))
    assert figures == sum("plt" in source or "plot" in source for source in build.code(notebook))
    page = build.notebook_page(path.stem, notebook, tmp_path)
    assert page.count(f"data:image/png;base64,{FIGURE}") == figures
    title, _ = build.heading(notebook)
    assert f"<title>{title} - sysid_btr</title>" in page
    assert "three replays" not in page  # progress
    assert f"[{title}]({path.stem}.html)" in build.notebooks_page()
    if figures:
        for cell in notebook.cells:
            cell.outputs = []
        with pytest.raises(ValueError, match="no figure"):
            build.notebook_page(path.stem, notebook, tmp_path)


def as_executed(build: ModuleType, path: Path) -> NotebookNode:
    """A notebook with a figure wherever a cell draws, and a line of progress everywhere."""
    notebook = nbformat.read(path, 4)
    for cell in (c for c in notebook.cells if c.cell_type == "code"):
        cell.execution_count = 1
        cell.outputs = [new_output("stream", name="stderr", text="fit: three replays")]
        if build.draws(cell.source):
            cell.outputs.append(new_output("display_data", data={"image/png": FIGURE}))
    return notebook


def test_a_notebook_is_executed_only_where_its_code_is_new(
    build: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = next((ROOT / "notebooks").glob("01*.ipynb"))
    begun: list[str] = []

    def execute(client: NotebookClient, cwd: str) -> None:
        begun.append(cwd)
        for cell in client.nb.cells:
            cell.update({"execution_count": 1} if cell.cell_type == "code" else {})

    monkeypatch.setattr(NotebookClient, "execute", execute)
    monkeypatch.setattr(build, "EXECUTED", tmp_path)
    build.executed(path)
    build.executed(path)
    assert begun == [str(ROOT / "notebooks")]
    kept = as_executed(build, path)
    nbformat.write(kept, tmp_path / path.name)
    kept.cells[0].source = "other words"
    nbformat.write(kept, tmp_path / path.name)
    found = build.executed(path)
    assert found.cells[0].source != "other words"
    assert found.cells[1].outputs
    for spoil in ({"source": "other = 'code'"}, {"outputs": [new_output("error")]}, {"execution_count": None}):
        spoilt = as_executed(build, path)
        spoilt.cells[1].update(spoil)
        nbformat.write(spoilt, tmp_path / path.name)
        before = len(begun)
        build.executed(path)
        assert len(begun) == before + 1


def test_reports_that_a_notebook_links_to_are_copied_beside_its_page(
    build: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "NOTEBOOKS", tmp_path / "notebooks")
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.html").write_text("found")
    body = "<a href='../out/report.html' target='_blank'>here</a> <a href='../out/lost.html' target='_blank'>lost</a>"
    html = tmp_path / "html"
    assert build.with_files(body, html) == '<a href="files/out/report.html">here</a> lost'
    assert (html / "files" / "out" / "report.html").read_text() == "found"


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ("log : commands and times.", "log\n    commands and times."),
        ("path : path-like\n    Where to.", "path : path-like\n    Where to."),
        (
            "a, b : the last fraction of each log, which is not fitted, or\n    others.",
            "a, b\n    the last fraction of each log, which is not fitted, or\n    others.",
        ),
        ("No entry: a sentence.", "No entry: a sentence."),
    ],
)
def test_a_description_beside_a_name_is_no_type(build: ModuleType, given: str, wanted: str) -> None:
    assert build.spaced(given) == wanted
