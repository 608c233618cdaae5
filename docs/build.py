"""``make docs``: the guide's pages, tables made from the code, the notebooks with their figures, and the API reference
from docstrings, as HTML.

    python docs/build.py [DIR]        # default docs/html

A page is a Markdown file in docs/guide; `PAGES` has those made from code. pdoc makes the reference, nbconvert the pages
of notebooks, with the outputs that the last `make test` or `make notebooks` left in `EXECUTED`. A notebook that was
never executed, or whose code has changed since, is executed first.
"""

from __future__ import annotations

import pkgutil
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from html import escape
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any

import nbformat
import pdoc
from nbformat import NotebookNode
from pdoc.render_helpers import to_html

import sysid_btr
import sysid_btr.posterior
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.library import effects

HERE = Path(__file__).parent
NOTEBOOKS = HERE.parent / "notebooks"
EXECUTED = HERE.parent / "executed"
"""Notebooks with outputs, beside NOTEBOOKS because paths in them are relative."""
TITLES = {
    "index": "Overview",
    "first_hour": "The first hour",
    "robot_and_log": "Your robot and your log",
    "verdicts": "What each verdict means",
    "reports": "The reports",
    "notebooks": "Notebooks",
    "effects": "Effects",
    "back_to_reality": "A controller that works on the robot",
    "servos": "Identified servos",
    "result": "result.json",
    "machines": "Many machines",
    "limits": "Limits",
    "architecture": "How it is built",
    "commands": "Commands",
    "reference": "API",
}
"""Pages in the order of the menu."""
NOT_DOCUMENTED = ("sysid_btr.cli", "sysid_btr.report.render_worker")
FRAME = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"><title>{title} - sysid_btr</title><style>
:root {{ --paper: #fff; --ink: #1f2328; --faint: #59636e; --line: #d1d9e0; --panel: #f6f8fa; --link: #0969da; }}
@media (prefers-color-scheme: dark) {{ :root {{
  --paper: #0d1117; --ink: #e6edf3; --faint: #9198a1; --line: #3d444d; --panel: #151b23; --link: #4493f8; }} }}
body {{ margin: 0 auto; max-width: 60rem; padding: 1.5rem 1.25rem 4rem; background: var(--paper); color: var(--ink);
  font: 16px/1.6 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }}
nav {{ border-bottom: 1px solid var(--line); padding-bottom: .6rem; margin-bottom: 1.5rem; }}
nav a {{ margin-right: 1.2rem; }} nav b {{ margin-right: 1.2rem; }}
a {{ color: var(--link); text-decoration: none; }} a:hover {{ text-decoration: underline; }}
h2 {{ margin-top: 2.2rem; }} h3 {{ margin-top: 1.6rem; }}
pre {{ background: var(--panel); padding: .8rem 1rem; overflow-x: auto; font-size: .85rem; line-height: 1.45; }}
code {{ font-family: ui-monospace, monospace; font-size: .9em; }} pre code {{ font-size: inherit; }}
table {{ border-collapse: collapse; display: block; overflow-x: auto; }}
th, td {{ padding: .35rem .9rem .35rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); }}
{style}</style></head><body><nav>{menu}</nav>
{body}
</body></html>
"""


LOOKS = """.highlight, .highlight pre { background: var(--panel); } .anchor-link { display: none; }
.output pre { background: none; padding: 0; } .output_stream pre { white-space: pre-wrap; }
.output_png img { max-width: 100%; height: auto; background: #fff; }
"""
"""Of notebooks: code on a panel, output on the page."""


def main(argv: list[str]) -> int:
    """Write all pages; 1 if a link leads nowhere."""
    out = Path(argv[0]) if argv else HERE / "html"
    shutil.rmtree(out, ignore_errors=True)
    for package in (sysid_btr, sysid_btr.posterior):
        for name in package.__all__:  # loaded when they are first used; pdoc looks for what is there
            setattr(package, name, getattr(package, name))
    # types that are imported for the type checker alone are shown by their names
    warnings.filterwarnings("ignore", "Error parsing type annotation", UserWarning)
    # a package brings its modules unless it says what it offers; all are wanted
    warnings.filterwarnings("ignore", "The module specification", UserWarning)
    convert = pdoc.docstrings.numpy
    pdoc.docstrings.numpy = lambda text: convert(spaced(text))
    pdoc.render.configure(docformat="numpy", footer_text="sysid_btr", show_source=False)
    pdoc.pdoc(*modules(), *(f"!{name}" for name in NOT_DOCUMENTED), r"!.*\._", output_directory=out / "api")
    for name, title in TITLES.items():
        text = PAGES[name]() if name in PAGES else (HERE / "guide" / f"{name}.md").read_text(encoding="utf-8")
        (out / f"{name}.html").write_text(page(name, title, text), encoding="utf-8")
    for path in notebooks():
        text = notebook_page(path.stem, executed(path), out)
        (out / f"{path.stem}.html").write_text(text, encoding="utf-8")
    broken = sorted(set(broken_links(out)))
    if broken:
        sys.stderr.write("links that lead nowhere:\n" + "\n".join(f"  {b}" for b in broken) + "\n")
        return 1
    sys.stdout.write(f"{out / 'index.html'}\n")
    return 0


def page(name: str, title: str, markdown: str) -> str:
    """A page of Markdown with the menu above it."""
    return framed(name, title, to_html(markdown))


def framed(name: str, title: str, body: str, style: str = "") -> str:
    """A page with the menu above it."""
    menu = [f"<b>{t}</b>" if n == name else f'<a href="{n}.html">{t}</a>' for n, t in TITLES.items()]
    return FRAME.format(title=escape(title), menu="\n".join(menu), body=body, style=style)


def notebooks() -> list[Path]:
    """All notebooks, in their order."""
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def heading(notebook: NotebookNode) -> tuple[str, str]:
    """Title of a notebook, and its first paragraph."""
    title, _, text = notebook.cells[0].source.partition("\n")
    return title.lstrip("# "), " ".join(text.strip().partition("\n\n")[0].split())


def notebooks_page() -> str:
    """Every notebook, with what it begins with."""
    lines = ["# Notebooks", "", "Worked examples with all their output; the files are in `notebooks/`.", ""]
    for path in notebooks():
        title, text = heading(nbformat.read(path, 4))
        lines += [f"## [{title}]({path.stem}.html)", "", text, ""]
    return "\n".join(lines)


def executed(path: Path) -> NotebookNode:
    """A notebook with outputs: those of its last execution, or of one now.

    An execution stands for a notebook as long as their code is the same, it came to the end, and no cell failed.
    """
    notebook, kept = nbformat.read(path, 4), EXECUTED / path.name
    if kept.exists():
        before = nbformat.read(kept, 4)
        if code(before) == code(notebook) and is_whole(before):
            return with_outputs(notebook, before)
    from nbclient import NotebookClient

    sys.stderr.write(f"executing {path.name}\n")
    NotebookClient(notebook, timeout=None).execute(cwd=str(NOTEBOOKS))
    kept.parent.mkdir(exist_ok=True)
    nbformat.write(notebook, kept)
    return notebook


def code(notebook: NotebookNode) -> list[str]:
    """Sources of the cells of code."""
    return [cell.source for cell in notebook.cells if cell.cell_type == "code"]


def is_whole(notebook: NotebookNode) -> bool:
    """Whether every cell was executed and none failed."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    failed = any(output.output_type == "error" for cell in cells for output in cell.outputs)
    return not failed and all(cell.execution_count for cell in cells)


def with_outputs(notebook: NotebookNode, before: NotebookNode) -> NotebookNode:
    """A notebook with the outputs that the same code had before; its text is its own."""
    outputs = iter(cell.outputs for cell in before.cells if cell.cell_type == "code")
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = next(outputs)
    return notebook


def notebook_page(name: str, notebook: NotebookNode, out: Path) -> str:
    """An executed notebook as a page; files that it links to are copied beside the page.

    Raises
    ------
    ValueError
        If a cell draws and the page would not have its figure.
    """
    from nbconvert import HTMLExporter
    from pygments.formatters import HtmlFormatter

    for cell in notebook.cells:
        if cell.cell_type == "code":
            # lines of progress
            cell.outputs = [o for o in cell.outputs if o.get("name") != "stderr"]
            if draws(cell.source) and not any("image/png" in o.get("data", {}) for o in cell.outputs):
                raise ValueError(f"{name}: no figure below\n{cell.source}")
    exporter = HTMLExporter(template_name="basic", exclude_input_prompt=True, exclude_output_prompt=True)
    body, _ = exporter.from_notebook_node(notebook)
    dark = HtmlFormatter(style="github-dark").get_style_defs(".highlight")
    style = f"{HtmlFormatter().get_style_defs('.highlight')}\n@media (prefers-color-scheme: dark) {{ {dark} }}\n{LOOKS}"
    body = body.replace("No description has been provided for this image", "figure")
    return framed(name, heading(notebook)[0], with_files(body, out), style)


def draws(source: str) -> bool:
    """Whether a cell ends in a figure."""
    return re.search(r"\bplt\.(figure|subplots)\(|\.plot\b", source) is not None


def with_files(body: str, out: Path) -> str:
    """HTML whose links to files beside the notebooks lead to copies beside the page; what is not there is no link."""

    def copied(link: re.Match[str]) -> str:
        source = NOTEBOOKS / link["target"]
        if not source.is_file():
            return link["text"]
        target = Path("files") / source.parent.name / source.name
        (out / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, out / target)
        return f'<a href="{target.as_posix()}">{link["text"]}</a>'

    return re.sub(r"""<a href=(['"])(?P<target>\.\./[^'"]+)\1[^>]*>(?P<text>.*?)</a>""", copied, body)


def effects_page() -> str:
    """Every effect of the library, as its class describes it."""
    lines = [
        "# Effects",
        "",
        "`close` looks for these by itself, but for factors of what a model states anyway (*declared*). `--effects "
        "NAME,NAME` confines it to some, or asks for one of those too. An effect that leaves the same trace as another "
        "is told from it only by the motion or sensor in the last column; without that the verdict is `ambiguous`.",
        "",
        "All of them can be freed: `--fit NAME:GLOB`, or `--fit NAME.PARAMETER:GLOB` for one parameter alone. The name "
        "of a model's own value stands for that value instead of a change of it.",
        "",
        "`free_torque`, `free_friction` and `free_reading` have no law: they are smooth curves over a variable, named "
        f"after a point, as in `--fit free_torque.load:*Knee`: {', '.join(f'`{e.label}`' for e in FREE_FORMS)}. The "
        "report draws them. A model in MJCF cannot hold them; `params.json` does.",
        "",
        "| name | other names | what | at | parameters (unit) | mistaken for, unless the log has |",
        "|---|---|---|---|---|---|",
    ]
    by_name: dict[str, list[type[Effect]]] = {}
    for effect in effects():
        by_name.setdefault(effect.name, []).append(effect)
    for name, variants in by_name.items():
        first = variants[0]
        kinds = ", ".join(f"{k.name} ({'-' if k.unit == '1' else k.unit})" for k in first.kinds)
        confounders = "; ".join(f"`{other}`: {what}" for other, what in first.confounders) or "-"
        own = [f"`{first.field}` (own value)"] if first.field else []
        others = ", ".join([*own, *(f"`{n}`" for n in first.also)]) or "-"
        what = first.title if first.usual else f"{first.title} (declared)"
        lines.append(f"| `{name}` | {others} | {what} | {first.scope} | {kinds} | {confounders} |")
    return "\n".join(lines) + "\n"


def result_page() -> str:
    """Every name in result.json, as its schema describes it."""
    from sysid_btr.result import result_schema

    schema = result_schema()
    lines = [
        "# result.json",
        "",
        f"{schema['description']} The same as a JSON schema: `sysid_btr.result.result_schema()`. As pandas tables: "
        '`sb.tables("out")`, whose names are those of the lists here, with `errors`, `joints` and `run` for the rest.',
        "",
        *_names(schema),
    ]
    for name, entry in schema["$defs"].items():
        if entry.get("properties"):
            lines += ["", f"## {name}", "", *_names(entry)]
    return "\n".join(lines) + "\n"


def _names(entry: dict[str, Any]) -> list[str]:
    """A table of the properties of an object."""
    rows = [f"| `{name}` | {_kind(e)} | {e.get('description', '')} |" for name, e in entry["properties"].items()]
    return ["| name | type | meaning |", "|---|---|---|", *rows]


def _kind(entry: dict[str, Any]) -> str:
    """The type of a value in words; what has a table of its own by its name."""
    if "$ref" in entry:
        return f"[{entry['$ref'].rpartition('/')[2]}](#{entry['$ref'].rpartition('/')[2]})"
    if "const" in entry:
        return f'"{entry["const"]}"'
    if "enum" in entry:
        return ", ".join(f'"{value}"' for value in entry["enum"])
    if "anyOf" in entry:
        return " or ".join(_kind(one) for one in entry["anyOf"])
    kind = entry.get("type", "any")
    if kind == "array":
        return f"list of {_kind(entry['items'])}"
    if kind == "object" and isinstance(entry.get("additionalProperties"), dict):
        return f"by name: {_kind(entry['additionalProperties'])}"
    if kind == "object" and entry.get("properties"):
        return "object of " + ", ".join(f"`{name}`" for name in entry["properties"])
    return " or ".join(kind) if isinstance(kind, list) else str(kind)


def commands_page() -> str:
    """Every verb with its help, as the command line prints it."""
    import typer

    from sysid_btr.cli import EXIT_CODES, app

    command = typer.main.get_command(app)
    lines = ["# Commands", "", "```text", EXIT_CODES.removeprefix("\b").strip(), "```", ""]
    for name, verb in sorted(command.commands.items()):  # type: ignore[attr-defined]
        context = verb.make_context(f"sysid-btr {name}", [], resilient_parsing=True, terminal_width=100)
        lines += [f"## {name}", "", "```text", verb.get_help(context), "```", ""]
    return "\n".join(lines)


ENTRY = re.compile(r"(?P<name>\*{0,2}[a-z_]\w*(?:, [a-z_]\w*)*) : (?P<text>.+)")
LONGEST_TYPE = 45


def spaced(docstring: str) -> str:
    """A docstring with the description of each parameter on a line of its own, where it stands beside the name.

    ``name : type`` stays: its description follows, indented, and a type is short and no sentence.
    """
    lines = docstring.split("\n")
    result = []
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        entry = ENTRY.fullmatch(line)
        if entry is None:
            result.append(line)
            continue
        text = entry["text"]
        typed = following.startswith("    ") and len(text) < LONGEST_TYPE and text[-1] not in ".,;:"
        result += [line] if typed else [entry["name"], f"    {text}"]
    return "\n".join(result)


def modules() -> list[str]:
    """Names of all public modules."""
    found = (m.name for m in pkgutil.walk_packages(sysid_btr.__path__, "sysid_btr."))
    return ["sysid_btr", *(n for n in found if "._" not in n and not n.startswith(NOT_DOCUMENTED))]


def reference_page() -> str:
    """All modules with what they are for; what most people need first."""
    lines = ["# API", "", "What `import sysid_btr as sb` offers:", "", "| | |", "|---|---|"]
    for name in sysid_btr.__all__:
        # the posterior is a package and a function
        known, place = getattr(sysid_btr, name), f"sysid_btr.html#{name}"
        if known is sysid_btr.posterior:
            known, place = sysid_btr.posterior.posterior, "sysid_btr/posterior.html#posterior"
        lines.append(f"| [`sb.{name}`](api/{place}) | {first_line(known)} |")
    for package, names in groupby(modules()[1:], lambda n: ".".join(n.split(".")[:2])):
        own = list(names)
        lines += ["", f"## {package}", "", "| | |", "|---|---|"]
        lines += [f"| [`{n}`](api/{n.replace('.', '/')}.html) | {first_line(import_module(n))} |" for n in own]
    return "\n".join(lines) + "\n"


def first_line(documented: object) -> str:
    """What a docstring begins with, up to its first empty line."""
    return " ".join((documented.__doc__ or "").strip().partition("\n\n")[0].split()).replace("|", "\\|")


PAGES: dict[str, Callable[[], str]] = {
    "notebooks": notebooks_page,
    "effects": effects_page,
    "result": result_page,
    "commands": commands_page,
    "reference": reference_page,
}


def broken_links(out: Path) -> Iterator[str]:
    """Links of the guide's pages to files that are not there."""
    for file in out.glob("*.html"):
        for link in re.findall(r'href="([^"#:]+)(?:#[^"]*)?"', file.read_text(encoding="utf-8")):
            if not (out / link).exists():
                yield f"{file.name}: {link}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
