"""Where the numerical code can be made wrong in one place, and which of these places a seed draws.

A place is a node of the syntax tree: an arithmetic operator, a minus sign, a conjugate, an index, a number. Left out
because nothing numerical stands there, by the tree itself: docstrings and strings, f-strings, `raise`, `assert`,
`warn`, the condition of an `if` that only raises, annotations, decorators, defaults of arguments, fields of classes
(settings and promises), comparisons of whole numbers with == (shapes, types), functions that return text, functions
of cost, and functions of bounds: what bounds say is right if it is larger too, and `bounds.py` tries them.
"""

import ast
import hashlib
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GROUPS = {
    "jones": ("instrument/jones/*.py", "instrument/mat2.py", "instrument/phasor.py"),
    "predict": ("instrument/predict/*.py",),
    "calibrate": ("instrument/calibrate/*.py",),
    "image": ("instrument/image/*.py",),
    "analyze": ("instrument/analyze/*.py", "instrument/analyze/*/*.py"),
    "foreground": ("instrument/foreground/*.py",),
    "observe": ("instrument/observe/*.py",),
    "elements": ("plugins/elements/*.py",),
    "telescopes": ("plugins/telescopes/*.py",),
    "sky": ("instrument/sky/*.py",),
}
# files and words, refusals, bounds, threads: no formula stands there
NOT_NUMERICAL = (
    "*/__init__.py", "*/sky/bbs*.py", "*/sky/*tables.py", "*/sky/columns.py", "*/sky/foreign.py", "*/sky/readers.py",
    "*/sky/ao_text.py", "*/sky/forms.py", "*/sky/doubts.py", "*/sky/rounding.py", "*/image/cube_file.py",
    "*/faraday/file.py", "*/cube_checks.py", "*/calibrate/reasons.py", "*/predict/rounding.py", "*/predict/threads.py",
)  # fmt: skip
KINDS = ("operator", "sign", "conjugate", "index", "number")
BOUNDS_AND_COSTS = {"rounding", "peak", "jump", "work", "phasors", "bound", "bytes", "memory", "cost", "items"}
SILENT = {"warn", "isinstance", "Field", "Work", "StageWork", "memory", "allocated", "len", "range"}
OTHER = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Pow: "*", ast.FloorDiv: "*", ast.Mod: "*"}
CONJUGATES = {"conj", "conjugate", "herm"}


@dataclass(frozen=True)
class Site:
    """One place: what stands there and what the mutant has instead, between these bytes of the file."""

    group: str
    path: str
    function: str
    kind: str
    line: int
    before: str
    after: str
    start: int
    end: int
    nth: int

    def rank(self, seed: int) -> str:
        """Where a seed sorts it; it does not depend on code elsewhere."""
        words = f"{seed}|{self.path}|{self.function}|{self.kind}|{self.before}|{self.nth}"
        return hashlib.sha256(words.encode()).hexdigest()

    def applied(self, source: bytes) -> bytes:
        """The file with the mutant in it."""
        return source[: self.start] + self.after.encode() + source[self.end :]


class Finder(ast.NodeVisitor):
    """All places of one file."""

    def __init__(self, group: str, path: str, source: bytes) -> None:
        self.group, self.path, self.source = group, path, source
        self.starts = [0]
        for line in source.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))
        self.names: list[str] = []
        self.found: list[Site] = []

    def span(self, node: ast.AST) -> tuple[int, int]:
        """First byte and the one after the last."""
        begin = self.starts[node.lineno - 1] + node.col_offset
        return begin, self.starts[node.end_lineno - 1] + node.end_col_offset

    def text(self, node: ast.AST) -> str:
        begin, end = self.span(node)
        return self.source[begin:end].decode()

    def add(self, kind: str, node: ast.AST, after: str) -> None:
        start, end = self.span(node)
        function, before = ".".join(self.names), self.text(node)
        nth = sum((s.function, s.kind, s.before) == (function, kind, before) for s in self.found)
        where = (self.group, self.path, function, kind, node.lineno)
        self.found.append(Site(*where, before, after, start, end, nth))

    # what holds no numbers -------------------------------------------------------------------------------------------

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        given = ast.unparse(node.returns) if node.returns else ""
        costs = BOUNDS_AND_COSTS & {node.name, *node.name.strip("_").split("_")}
        if (
            costs
            or given.split("[")[0] in ("str", "Work", "StageWork", "Items")
            or given.startswith(("str |", "list[str"))
        ):
            return
        self.names.append(node.name)
        for statement in node.body:
            self.visit(statement)
        self.names.pop()

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self.names.append(node.name)
        for statement in node.body:
            if isinstance(statement, ast.FunctionDef):
                self.visit(statement)
        self.names.pop()

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_If(self, node: ast.If) -> None:
        refuses = isinstance(node.body[-1], ast.Raise)
        for part in (*(() if refuses else (node.test,)), *node.body, *node.orelse):
            self.visit(part)

    def skip(self, node: ast.AST) -> None:
        """Nothing numerical."""

    visit_Raise = visit_Assert = visit_JoinedStr = visit_Import = visit_ImportFrom = skip

    # places ----------------------------------------------------------------------------------------------------------

    def visit_BinOp(self, node: ast.BinOp) -> None:
        left, right = self.text(node.left), self.text(node.right)
        words = (ast.List, ast.Tuple, ast.JoinedStr)
        worded = any(
            isinstance(x, words) or isinstance(getattr(x, "value", None), str) for x in (node.left, node.right)
        )
        if isinstance(node.op, ast.MatMult) and left != right:  # y @ y is the same either way
            self.add("operator", node, f"({right}) @ ({left})")
        elif type(node.op) in OTHER and not worded:
            self.add("operator", node, f"(({left}) {OTHER[type(node.op)]} ({right}))")
        for side in (node.left, node.right):
            self.visit(side)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        worded = isinstance(node.value, ast.List | ast.Tuple | ast.ListComp | ast.JoinedStr)
        if type(node.op) in OTHER and not worded:
            self.add("operator", node, f"{self.text(node.target)} {OTHER[type(node.op)]}= {self.text(node.value)}")
        self.visit(node.target)
        self.visit(node.value)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self.add("sign", node, f"({self.text(node.operand)})")
        elif isinstance(node.op, ast.USub):
            self.add("number", node, f"({self.text(node.operand)})")
            return
        self.visit(node.operand)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in SILENT or name.endswith("Error"):
            return
        if name in CONJUGATES:
            inner = node.args[0] if node.args else node.func.value
            self.add("conjugate", node, f"({self.text(inner)})")
        self.visit(node.func)
        for given in node.args:
            self.visit(given)
        for word in node.keywords:
            self.indexed(word.value) if word.arg == "axis" else self.visit(word.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        if any(isinstance(op, ast.Eq | ast.NotEq | ast.In | ast.NotIn | ast.Is | ast.IsNot) for op in node.ops):
            return
        self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        self.visit(node.value)
        self.indexed(node.slice)

    def indexed(self, node: ast.AST | None) -> None:
        """Numbers between brackets, and axes."""
        if isinstance(node, ast.Tuple):
            for part in node.elts:
                self.indexed(part)
        elif isinstance(node, ast.Slice):
            for part in (node.lower, node.upper, node.step):
                self.indexed(part)
        elif isinstance(node, ast.Constant) and type(node.value) is int:
            self.add("index", node, str(node.value - 1 if node.value > 0 else 1))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.operand, ast.Constant):
            self.add("index", node, f"{-node.operand.value - 1}" if isinstance(node.operand.value, int) else "0")
        elif node is not None:
            self.visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if type(node.value) is int:
            self.add("number", node, str(node.value + 1))
        elif type(node.value) is float and abs(node.value) < float("inf"):
            self.add("number", node, repr(2 * node.value if node.value else 1.0))
        elif type(node.value) is complex:
            self.add("sign", node, f"({-node.value!r})")


def modules(root: Path = ROOT) -> dict[str, list[str]]:
    """The files of each group, relative to the root."""
    found = {}
    for group, patterns in GROUPS.items():
        paths = sorted(p.relative_to(root).as_posix() for pattern in patterns for p in root.glob(pattern))
        found[group] = [p for p in paths if not any(fnmatch(p, no) for no in NOT_NUMERICAL)]
    return found


def sites(root: Path = ROOT) -> list[Site]:
    """Every place of the numerical code."""
    found = []
    for group, paths in modules(root).items():
        for path in paths:
            source = (root / path).read_bytes()
            finder = Finder(group, path, source)
            finder.visit(ast.parse(source))
            found += finder.found
    return found


def drawn(seed: int, count: int, given: list[Site]) -> list[Site]:
    """So many of them: the groups in turn, in each the kinds in turn from one that the seed picks, then by rank."""
    out: list[Site] = []
    first = {g: int(hashlib.sha256(f"{seed}|{g}".encode()).hexdigest(), 16) for g in GROUPS}
    for k in range(count):
        group, turn = list(GROUPS)[k % len(GROUPS)], k // len(GROUPS)
        left = [s for s in given if s.group == group and s not in out]
        for step in range(len(KINDS)):
            kind = KINDS[(first[group] + turn + step) % len(KINDS)]
            if fitting := [s for s in left if s.kind == kind]:
                out.append(min(fitting, key=lambda s: s.rank(seed)))
                break
    return out
