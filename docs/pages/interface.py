"""A page for each public name of the package, and for each record that a public function returns."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any, get_overloads

import gradscape
from gradscape.envs.adapters import DEFAULTS
from gradscape.jobs.scene import SceneSpec

from .text import CODE, cell, code, contents, page, table

RST = re.compile(r"([\\*_|])")  # what would be markup in a docstring
KEYWORDS = re.compile(r"Unpack\[(\w+)\]")


def pages() -> dict[str, str]:
    """Return a page for each name, by whether it is a function, a class, or what a function returns."""
    public = {name: getattr(gradscape, name) for name in gradscape.__all__ if not name.startswith("__")}
    functions = {f"gradscape.{name}": one for name, one in public.items() if not inspect.isclass(one)}
    classes = {f"gradscape.{name}": one for name, one in public.items() if inspect.isclass(one)}
    records = {name: one for name, one in returned(functions.values()) if one not in public.values()}
    written = {
        **{f"functions/{name.rpartition('.')[2]}": _function(name, one) for name, one in functions.items()},
        **{f"classes/{name.rpartition('.')[2]}": _class(name, one) for name, one in classes.items()},
        **{f"records/{name.rpartition('.')[2]}": _class(name, one) for name, one in records.items()},
    }
    return {"api/index.md": _index(written, functions | classes | records)} | {
        f"api/{name}.md": text for name, text in written.items()
    }


def returned(functions: Any) -> Iterator[tuple[str, type]]:
    """Yield each class of this package that a function is annotated to return, by its full name, once."""
    seen: set[type] = set()
    for function in (one for public in functions for one in (public, *get_overloads(public))):
        names = names_of(import_module(function.__module__))
        annotated = str(inspect.signature(function).return_annotation)
        for found in (names.get(word) for word in re.findall(r"\w+", annotated)):
            if inspect.isclass(found) and found.__module__.startswith("gradscape.") and found not in seen:
                seen.add(found)
                yield f"{found.__module__}.{found.__name__}", found


def names_of(module: Any) -> dict[str, Any]:
    """Return what the names in a module's annotations mean, those too that only a type checker imports."""
    tree = ast.parse(inspect.getsource(module))
    checked = [node for node in tree.body if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)]
    imports = [one for node in checked for one in ast.walk(node) if isinstance(one, ast.ImportFrom)]
    found = dict(vars(module))
    for one in imports:
        home = import_module("." * one.level + (one.module or ""), module.__package__)
        found |= {alias.asname or alias.name: getattr(home, alias.name) for alias in one.names}
    return found


def to_rst(app: Any, what: str, name: str, one: Any, options: Any, lines: list[str]) -> None:
    """Turn a docstring of this house into what autodoc reads: what is in backticks is code, what is indented too."""
    blocks = re.split(r"\n\n+", "\n".join(lines))
    literal = [all(line.startswith("    ") for line in block.splitlines()) for block in blocks]
    told = ["::\n\n" + block if code else _escape(block) for block, code in zip(blocks, literal, strict=True) if block]
    lines[:] = [*"\n\n".join(told).splitlines(), ""]


def tidy_shapes(app: Any, what: str, name: str, one: Any, options: Any, said: str | None, back: str | None) -> Any:
    """Leave out the blank that tells a linter that a shape's only axis is no name that it should know."""
    return tuple(text and text.replace("' ", "'") for text in (said, back))


def _escape(text: str) -> str:
    parts = CODE.split(text)
    told = "".join(f"\0`{part}`\0" if CODE.fullmatch(part) else RST.sub(r"\\\1", part) for part in parts)
    parted = re.sub(r"(?<=\w)\0|\0(?=[\w(])", r"\\ ", told)  # code that touches a word
    return parted.replace("\0", "")


def _index(written: dict[str, str], documented: dict[str, Any]) -> str:
    """Return the page that lists all others."""
    summaries = {name.rpartition(".")[2]: _summary(one) for name, one in documented.items()}
    parts = []
    for folder, title in (("functions", "Functions"), ("classes", "Classes"), ("records", "What functions return")):
        files = [name for name in written if name.startswith(f"{folder}/")]
        rows = [(f"[`{file.partition('/')[2]}`]({file}.md)", summaries[file.partition("/")[2]]) for file in files]
        parts += [f"## {title}", table(("name", "what it is"), rows), contents(files, options=[":hidden:"])]
    said = "`import gradscape as gs` loads nothing heavy; each name is imported when it is first used."
    return page("The Python interface", said, *parts)


def _summary(one: Any) -> str:
    return cell((inspect.getdoc(one) or "").split("\n\n")[0])


def _function(name: str, one: Callable[..., Any]) -> str:
    return page(name, _rst(f".. autofunction:: {name}"), _keywords(one))


def _class(name: str, one: type) -> str:
    """Return the page of a class, with what it inherits from other classes of this package."""
    foreign = ", ".join(base.__name__ for base in one.__mro__ if not base.__module__.startswith("gradscape"))
    members = ("   :members:", "   :undoc-members:", f"   :inherited-members: {foreign}", "   :show-inheritance:")
    title = name if name.count(".") == 1 else one.__name__
    return page(title, _rst(f".. autoclass:: {name}", *members))


def _rst(*lines: str) -> str:
    return "\n".join(["```{eval-rst}", *lines, "```"])


def _keywords(one: Callable[..., Any]) -> str:
    """Return a table of what `**keywords` may be, where a function takes those of a scene or of a function."""
    told = [KEYWORDS.fullmatch(str(parameter.annotation)) for parameter in inspect.signature(one).parameters.values()]
    kinds = [names_of(import_module(one.__module__))[match[1]] for match in told if match]
    defaults = {**vars(SceneSpec("")), **DEFAULTS}
    rows = [
        (f"`{name}`", f"`{_type(kind)}`", f"`{defaults[name]!r}`")
        for keywords in kinds
        for name, kind in keywords.__annotations__.items()
    ]
    return f"Its `keywords` are\n\n{table(('keyword', 'type', 'default'), rows)}" if rows else ""


def _type(annotation: Any) -> str:
    said = getattr(annotation, "__forward_arg__", annotation)
    return code(str(said))
