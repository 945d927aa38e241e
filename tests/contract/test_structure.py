"""The size and the shape of the source tree do not grow past what they have reached. BOUNDS is the place to change."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property, partial

import pytest

from tests.contract.test_imports import FILES, imported, nodes
from tests.places import ROOT

# A figure that shrinks by much gets a lower bound. A change that raises one says why in its commit.
BOUNDS = {
    # Without blank lines, comments and docstrings. What one folder gains, another loses in the same commit.
    "code lines of calibration": 32_975,
    "code lines of models": 6_469,
    "code lines of systems": 19_389,
    "code lines of tools": 23_975,
    "code lines of welding": 9_603,
    "positional calls": 0,  # constructor calls with more than LONGEST_CALL positional arguments
    "positional dataclasses": 0,  # with more than LONGEST_CALL fields and without kw_only
    "import cycles": 0,  # modules that import themselves through others, imports under TYPE_CHECKING included
    "full folders": 0,  # outside tools/, with more than FULLEST_FOLDER modules
    "long lines": 0,  # in the five folders, over LONGEST_LINE characters
    "layout by hand": 19,  # statements in the five folders that ruff does not format
    "bare constants": 0,  # float constants of the mathematics and the systems without a comment
    "shared class names": 0,  # public class names that occur in more than one module
}
LONGEST_CALL = 6
LONGEST_LINE = 120
FULLEST_FOLDER = 15
FOLDERS = ("calibration", "models", "systems", "tools", "welding")
SHOWN = 20  # places in a failure

Places = list[str]


class Sources:
    """Parsed files by their path below the project's root."""

    def __init__(self, texts: Mapping[str, str]) -> None:
        self.texts = texts
        self.trees = {path: ast.parse(text, filename=path) for path, text in texts.items()}
        self.modules = {_module(path): path for path in texts if not path.startswith("tests/")}

    def code(self) -> dict[str, ast.Module]:
        """The files of the package that hold more than a docstring."""
        found = {path: self.trees[path] for path in self.modules.values()}
        return {path: tree for path, tree in found.items() if any(not isinstance(node, ast.Expr) for node in tree.body)}

    def needed(self, module: str) -> set[str]:
        """The modules that a module imports, at its top or inside a function."""
        dotted = imported(self.trees[self.modules[module]])
        names = {name if name in self.modules else _parent(name) for name in dotted}
        return {name for name in names if name in self.modules} - {module}

    @cached_property
    def graph(self) -> dict[str, set[str]]:
        """The modules that each module imports."""
        return {module: self.needed(module) for module in self.modules}


def _module(path: str) -> str:
    return "weldcal." + path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _parent(dotted: str) -> str:
    return dotted.rpartition(".")[0]


def _reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    """The modules that can be reached from one by at least one import."""
    found: set[str] = set()
    new = set(graph.get(start, ()))
    while new:
        found |= new
        new = {target for module in new for target in graph[module]} - found
    return found


def _prose(tree: ast.Module) -> set[int]:
    """The lines of all docstrings."""
    lines: set[int] = set()
    for node in nodes(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            first = node.body[0]
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                lines |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return lines


def _code_lines(text: str, tree: ast.Module) -> int:
    prose = _prose(tree)
    lines = (line.strip() for number, line in enumerate(text.splitlines(), 1) if number not in prose)
    return sum(bool(line) and not line.startswith("#") for line in lines)


def _by_size(lengths: Mapping[str, int]) -> tuple[int, Places]:
    return sum(lengths.values()), [f"{path}: {n}" for path, n in sorted(lengths.items(), key=lambda item: -item[1])]


def _classes(sources: Sources) -> Iterator[tuple[str, ast.ClassDef]]:
    for path in sources.modules.values():
        for node in nodes(sources.trees[path]):
            if isinstance(node, ast.ClassDef):
                yield path, node


def _fields(node: ast.ClassDef) -> int:
    return sum(isinstance(part, ast.AnnAssign) and "ClassVar" not in ast.unparse(part.annotation) for part in node.body)


def code_lines(folder: str, sources: Sources) -> tuple[int, Places]:
    """The lines of code of one of the five folders, the longest files first."""
    mine = {path: tree for path, tree in sources.code().items() if path.startswith(f"{folder}/")}
    return _by_size({path: _code_lines(sources.texts[path], tree) for path, tree in mine.items()})


def positional_calls(sources: Sources) -> tuple[int, Places]:
    """The constructor calls, in the package and in tests, whose arguments are told apart by their order alone."""
    names = {node.name for _, node in _classes(sources)}
    found = [
        f"{path}:{node.lineno} {called} ({len(node.args)})"
        for path, tree in sources.trees.items()
        for node in nodes(tree)
        if isinstance(node, ast.Call) and len(node.args) > LONGEST_CALL
        if (called := getattr(node.func, "id", getattr(node.func, "attr", ""))) in names
    ]
    return len(found), found


def positional_dataclasses(sources: Sources) -> tuple[int, Places]:
    """The large dataclasses whose constructors take positional arguments."""
    found = [
        f"{path}:{node.lineno} {node.name} ({_fields(node)})"
        for path, node in _classes(sources)
        for decorator in map(ast.unparse, node.decorator_list)
        if "dataclass" in decorator and "kw_only=True" not in decorator and _fields(node) > LONGEST_CALL
    ]
    return len(found), found


def cycles(sources: Sources) -> tuple[int, Places]:
    """The modules that import themselves through others."""
    graph = sources.graph
    found = [module for module in sorted(graph) if module in _reached(graph, module)]
    return len(found), found


def full_folders(sources: Sources) -> tuple[int, Places]:
    """The folders outside tools/ with too many modules."""
    folders = [path.rpartition("/")[0] for path in sources.code() if not path.endswith("/__init__.py")]
    counts = {folder: folders.count(folder) for folder in sorted(set(folders)) if folder.split("/")[0] != "tools"}
    found = [f"{folder}: {n}" for folder, n in counts.items() if n > FULLEST_FOLDER]
    return len(found), found


def _lines(sources: Sources) -> Iterator[tuple[str, str]]:
    for path in sources.modules.values():
        for number, line in enumerate(sources.texts[path].splitlines(), 1):
            yield f"{path}:{number}", line


def long_lines(sources: Sources) -> tuple[int, Places]:
    """The lines that are too long to read beside another file."""
    found = [place for place, line in _lines(sources) if len(line) > LONGEST_LINE]
    return len(found), found


def layout_by_hand(sources: Sources) -> tuple[int, Places]:
    """The statements that are left out of formatting: tables whose columns are aligned."""
    found = [place for place, line in _lines(sources) if "# fmt: " in line]
    return len(found), found


def bare_constants(sources: Sources) -> tuple[int, Places]:
    """The float constants without a comment on their line or the line above."""
    found = []
    for path, tree in sources.trees.items():
        lines = ["", *sources.texts[path].splitlines()]
        for node in tree.body if path.startswith(("calibration/", "welding/", "systems/")) else []:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            value = getattr(node, "value", None)
            value = value.operand if isinstance(value, ast.UnaryOp) else value
            named = all(isinstance(target, ast.Name) and target.id.strip("_").isupper() for target in targets)
            commented = "#" in lines[node.lineno] or lines[node.lineno - 1].strip().startswith("#")
            if named and isinstance(value, ast.Constant) and isinstance(value.value, float) and not commented:
                found.append(f"{path}:{node.lineno} {lines[node.lineno].strip()}")
    return len(found), found


def shared_class_names(sources: Sources) -> tuple[int, Places]:
    """The public class names that two modules have."""
    users: dict[str, set[str]] = {}
    for path in sources.modules.values():
        for node in sources.trees[path].body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                users.setdefault(node.name, set()).add(path)
    found = [f"{name}: {', '.join(sorted(paths))}" for name, paths in sorted(users.items()) if len(paths) > 1]
    return len(found), found


MEASURES: dict[str, Callable[[Sources], tuple[int, Places]]] = {
    **{f"code lines of {folder}": partial(code_lines, folder) for folder in FOLDERS},
    "positional calls": positional_calls,
    "positional dataclasses": positional_dataclasses,
    "import cycles": cycles,
    "full folders": full_folders,
    "long lines": long_lines,
    "layout by hand": layout_by_hand,
    "bare constants": bare_constants,
    "shared class names": shared_class_names,
}


def verdict(figure: str, sources: Sources, bound: int) -> str:
    """Empty where a figure keeps its bound; else the figure, its bound and the places."""
    value, places = MEASURES[figure](sources)
    if value <= bound:
        return ""
    more = [f"... and {len(places) - SHOWN} more"] if len(places) > SHOWN else []
    return "\n  ".join([f"{figure}: {value}, and the bound is {bound}.", *places[:SHOWN], *more])


@cache
def tree() -> Sources:
    """The project's own files."""
    tests = {path.relative_to(ROOT).as_posix(): path for path in sorted((ROOT / "tests").rglob("*.py"))}
    return Sources({name: path.read_text(encoding="utf-8") for name, path in {**FILES, **tests}.items()})


@pytest.fixture(scope="module", autouse=True)
def forgotten() -> Iterator[None]:
    """The parsed files are not kept for the tests after these."""
    yield
    tree.cache_clear()
    nodes.cache_clear()


@pytest.mark.parametrize("figure", BOUNDS)
def test_a_figure_keeps_its_bound(figure: str) -> None:
    problem = verdict(figure, tree(), BOUNDS[figure])
    assert not problem, problem


SMALL = {
    "tools/commands/calibrate.py": '"""Doc."""\nfrom weldcal.models import used\n',
    "models/used.py": '"""Doc."""\n# a comment\n\nX = 1\n',
    "models/__init__.py": '"""Nothing but a docstring."""\n',
    "tests/models/test_used.py": "from weldcal.models.used import X\n",
}
SEVEN = "".join(f"    f{k}: int\n" for k in range(7))
OFFENDERS = {
    **{f"code lines of {folder}": {f"{folder}/used.py": '"""Doc."""\nX = 1\nY = 2\n'} for folder in FOLDERS},
    "positional calls": {
        "models/used.py": "class A:\n    pass\n",
        "tests/models/test_used.py": "import weldcal.models.used as u\nu.A(1, 2, 3, 4, 5, 6, 7)\n",
    },
    "positional dataclasses": {"models/used.py": f"@dataclass(frozen=True)\nclass A:\n{SEVEN}"},
    "import cycles": {"models/used.py": "from weldcal.tools.commands import calibrate\n"},
    "full folders": {f"calibration/m{k}.py": "Y = 2\n" for k in range(16)},
    "long lines": {"models/used.py": f"X = {'1' * 117}\n"},
    "layout by hand": {"models/used.py": "X = [1,  2]  # fmt: skip\n"},
    "bare constants": {"welding/used.py": "# why\n\nX = -1.5\n"},
    "shared class names": {"models/a.py": "class A:\n    pass\n", "welding/b.py": "class A:\n    pass\n"},
}


@pytest.mark.parametrize("figure", BOUNDS)
def test_a_figure_that_grows_is_named_with_its_places(figure: str) -> None:
    small, grown = Sources(SMALL), Sources({**SMALL, **OFFENDERS[figure]})
    value, _ = MEASURES[figure](small)
    assert verdict(figure, small, value) == ""
    problem = verdict(figure, grown, value)
    assert problem.startswith(f"{figure}: "), problem
    assert f"the bound is {value}" in problem
    assert len(problem.splitlines()) > 1, "the places are named"


def test_what_is_allowed_raises_no_figure() -> None:
    allowed = f"@dataclass(frozen=True, kw_only=True)\nclass A:\n{SEVEN}\n\nA(f0=1, f1=2)\nprint(1, 2, 3, 4, 5, 6, 7)\n"
    sources = Sources({**SMALL, "models/used.py": allowed})
    assert [MEASURES[figure](sources)[0] for figure in ("positional calls", "positional dataclasses")] == [0, 0]
