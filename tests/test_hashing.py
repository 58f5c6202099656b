"""A source's hash is of what the source does: wording and layout do not count, everything else does."""

from __future__ import annotations

import ast
import hashlib
import io
import keyword
import tokenize
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import bayeskin
from bayeskin import mechanisms
from bayeskin.hashing import sha256_of_behaviour, sha256_of_input
from bayeskin.mechanisms.hashes import law_source
from bayeskin.workflow import diagnosing_sources, diagnosis

PACKAGE = Path(bayeskin.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
EVERY_KIND = '''
"""A module."""
from __future__ import annotations
import asyncio as aio, os.path
from . import x as y

@decorated(1, key=None, *[], **{})
class C(B, metaclass=M):
    """A class."""
    field: int = 0x10
    (other): "str" = u"text"
    def method(self, a, /, b=1.50, *c, d=..., **e) -> None:
        """A method."""
        global g
        g = [*c, {**e}, {1, 2}, (lambda v: v ** -2)(a), not a, a @ b, 3j, b"bytes", 1_000]
        return f"{a!r:>{b}} {d=} {{}} {g:}" "and" 'more'
    async def other(self):
        async with aio.lock() as lock, lock: pass
        return [i async for i in self if i if not i], await self, (yield)

def empty():
    """A function."""

try:
    while (n := next(items)) != 3: del n[1:2, ::3]
    else: raise ValueError from None
except* (KeyError, OSError) as error:
    assert error, "that" if error else """many
    lines"""
finally:
    """Nothing."""
match point:
    case {"x": 0, **rest} | [_, *_] if True: pass
    case C(1, field=None) as c: nonlocal_ = c
'''


def hashed(source: str) -> str:
    return sha256_of_behaviour(source.encode())


def sources() -> st.SearchStrategy[str]:
    return st.sampled_from(
        [EVERY_KIND, *(path.read_text() for path in MODULES if path.stat().st_size < 9000)]
    )


def tokens(source: str, kind: int) -> list[tokenize.TokenInfo]:
    return [token for token in tokenize.generate_tokens(io.StringIO(source).readline) if token.type == kind]


def replaced(source: str, old: tokenize.TokenInfo, text: str) -> str:
    lines = source.splitlines(keepends=True)
    row, start = old.start
    lines[row - 1] = lines[row - 1][:start] + text + lines[row - 1][old.end[1] :]
    return "".join(lines)


WORDS = st.text(st.characters(exclude_categories=("C", "Z")) | st.just(" "), max_size=20)


@settings(deadline=None, max_examples=60)
@given(sources(), WORDS, st.integers(0, 20), st.data())
def test_comments_and_blank_lines_do_not_count(
    source: str, words: str, indent: int, data: st.DataObject
) -> None:
    end = data.draw(st.sampled_from(tokens(source, tokenize.NEWLINE)))
    commented = replaced(source, end, f"  # {words}\n\n{' ' * indent}# {words}\n\n")
    assert commented != source
    assert hashed(commented) == hashed(source)


@settings(deadline=None, max_examples=60)
@given(sources(), WORDS, st.data())
def test_a_docstring_does_not_count(source: str, words: str, data: st.DataObject) -> None:
    tree = ast.parse(source)
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [node for node in ast.walk(tree) if isinstance(node, kinds)]
    node = data.draw(st.sampled_from(nodes))
    if ast.get_docstring(node) is not None:
        del node.body[0]
    assume(not node.body or ast.get_docstring(node) is None)
    node.body.insert(0, ast.Expr(ast.Constant(words)))
    assert hashed(ast.unparse(tree)) == hashed(source)


@settings(deadline=None, max_examples=60)
@given(sources(), st.sampled_from(["7919", "0.7919", "7919j"]), st.data())
def test_every_number_counts(source: str, number: str, data: st.DataObject) -> None:
    numbers = tokens(source, tokenize.NUMBER)
    assume(numbers)
    changed = replaced(source, data.draw(st.sampled_from(numbers)), number)
    ast.parse(changed)
    assert hashed(changed) != hashed(source)


@settings(deadline=None, max_examples=60)
@given(sources(), st.data())
def test_every_name_counts(source: str, data: st.DataObject) -> None:
    reserved = {*keyword.kwlist, *keyword.softkwlist}
    names = [token for token in tokens(source, tokenize.NAME) if token.string not in reserved]
    assume(names)
    name = data.draw(st.sampled_from(names))
    changed = replaced(source, name, f"{name.string}_other")
    ast.parse(changed)
    assert hashed(changed) != hashed(source)


def without_docstrings(source: str) -> str:
    """The source as Python itself writes it, with ``pass`` in the place of docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        first = getattr(node, "body", None) or [None]
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and (
            isinstance(first[0], ast.Expr)
            and isinstance(first[0].value, ast.Constant)
            and isinstance(first[0].value.value, str)
        ):
            first[0] = ast.Pass()
    return ast.unparse(tree)


def test_every_third_module_hashes_as_its_bare_text_and_as_no_other() -> None:
    bare_by_hash: dict[str, str] = {}
    for path in MODULES[::3]:
        source = path.read_text()
        bare = without_docstrings(source)
        of_source = hashed(source)
        assert hashed(bare) == of_source, path
        assert bare_by_hash.setdefault(of_source, bare) == bare, path
    assert len(bare_by_hash) > 100


def test_the_hash_is_the_same_by_every_version_of_python() -> None:
    assert hashed(EVERY_KIND) == "b9394a897ce6fb6f227120ab6958fb0329b7aa57d6691fa58b310a815235b533"


@pytest.mark.parametrize(
    ("source", "other"),
    [
        ("x = 'a'", 'x = ("a")'),
        ("x = 'a' 'b'", "x = u'''ab'''"),
        ("x = 1000", "x = 1_000;"),
        ("x = f(1,\n  2)", "x = f(1, 2,)"),
        ("def f():\n    'Says it.'", "def f(): pass"),
        ("'Says it.'\nx = 1", "x = 1"),
        ("'Says it.'", ""),
        ("async def f():\n\t'Says it.'\n\treturn 1", "async def f(): return 1"),
        ("class C:\n    'Says it.'\n    a: int", "class C:\n  '''Says\n  more.'''\n  a: int"),
        ("x = 1", "\ufeffx = 1\r\n"),
    ],
)
def test_wording_and_layout_do_not_count(source: str, other: str) -> None:
    assert hashed(source) == hashed(other)


@pytest.mark.parametrize(
    ("source", "other"),
    [
        ("x = 1", "x = 2"),
        ("x = 1", "x = 1.0"),
        ("x = 1", "x = True"),
        ("x = None", "x = ..."),
        ("x = 'a'", "x = b'a'"),
        ("x = 'a'", "x = a"),
        ("x = '1'", "x = 1"),
        ("x = ''", "x = None"),
        ("x = []", "x = ()"),
        ("x = [None]", "x = []"),
        ("x = ['', 1]", "x = [1]"),
        ("x = {**a}", "x = {None: a}"),
        ("x = a + b", "x = a - b"),
        ("x = a - b", "x = b - a"),
        ("x = (a + b) * c", "x = a + b * c"),
        ("x = a < b", "x = a <= b"),
        ("x = -1", "x = 1"),
        ("x = 1", "x += 1"),
        ("x = f'{a}'", "x = f'{a!r}'"),
        ("x = f'{a}'", "x = f'{a:.2f}'"),
        ("x = f'{a}'", "x = f' {a}'"),
        ("x = a.b", "x = a.c"),
        ("x = f(a)", "x = f(a=a)"),
        ("x = f(a)", "x = f(*a)"),
        ("import a", "import a as b"),
        ("from a import b", "from .a import b"),
        ("from a import b", "from a import c"),
        ("x = 1\ny = 2", "y = 2\nx = 1"),
        ("def f(a): return a", "def f(a=1): return a"),
        ("def f(a=1): return a", "def f(a=2): return a"),
        ("def f(*, a, b=1): return a", "def f(*, a=1, b): return a"),
        ("def f(a): return a", "def f(a: int): return a"),
        ("def f(a): return a", "@cached\ndef f(a): return a"),
        ("def f(a): return a", "async def f(a): return a"),
        ("@dataclass\nclass C:\n    a: int", "@dataclass\nclass C:\n    a: float"),
        ("class C(BaseModel):\n    a: int", "class C(BaseModel):\n    a: int = 0"),
        ("class C: pass", "class C(B): pass"),
        ("for a in b:\n    c()\nd()", "for a in b:\n    c()\n    d()"),
        ("if a: b()\nelse: pass\nc()", "if a: b()\nelse: c()"),
        ("try: pass\nfinally: a()", "try: a()\nfinally: pass"),
        ("def f():\n    'Says it.'\n    'More.'", "def f():\n    'Says it.'\n    'Else.'"),
        ("x = 1\n'More.'", "x = 1"),
        ("if a:\n    'More.'", "if a:\n    'Else.'"),
        ("def f():\n    f'Says it.'", "def f(): pass"),
    ],
)
def test_whatever_may_change_a_result_counts(source: str, other: str) -> None:
    ast.parse(source)
    ast.parse(other)
    assert hashed(source) != hashed(other)


@pytest.mark.parametrize(
    "source",
    [
        b"def f(:\n",
        b"x = '\xff'\n",
        b"x = 1\x00",
        b"# coding: nonsense\n",
        b"x = " + b"(" * 9000,
        b"x = " + b"-" * 99999 + b"1",
        b"x = 0x" + b"f" * 9000,  # its decimals are more than Python writes
    ],
)
def test_what_python_cannot_parse_goes_by_its_bytes(source: bytes) -> None:
    assert sha256_of_behaviour(source) == hashlib.sha256(source).hexdigest()
    assert sha256_of_behaviour(source) != sha256_of_behaviour(source + b"# a comment")


@pytest.mark.filterwarnings("error")
def test_an_escape_that_python_warns_of_does_not_matter() -> None:
    assert hashed(r"x = '\d'") == hashed(r"x = '\\d'  # a comment")


def test_a_sum_of_two_thousand_terms_has_a_hash_without_its_comments() -> None:
    long = "x = " + " + ".join(["a"] * 2000)
    assert hashed(long) == hashed(f"{long}  # a comment")
    assert hashed(long) != hashed(f"{long} + a")


def test_data_go_by_their_bytes(tmp_path: Path) -> None:
    table, source = tmp_path / "table.json", tmp_path / "source.py"
    table.write_text("{}")
    source.write_text("x = {}")
    before = sha256_of_input(table), sha256_of_input(source)
    table.write_text("{ }")
    source.write_text("x = { }")
    assert sha256_of_input(table) != before[0]
    assert sha256_of_input(source) == before[1]
    assert sha256_of_input(tmp_path / "absent.py") == sha256_of_input(tmp_path / "absent.json") == ""


def test_verdicts_hold_after_a_comment_and_not_after_a_constant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = copytree(PACKAGE, tmp_path / "bayeskin", ignore=ignore_patterns("__pycache__"))
    monkeypatch.setattr(diagnosing_sources, "PACKAGE", copy)
    for module in (diagnosis, mechanisms):
        monkeypatch.setattr(module, "__file__", str(copy / Path(module.__file__).relative_to(PACKAGE)))
    before = diagnosing_sources.diagnosing_sources()
    changed = copy / "finite_element" / "lagrangian.py"
    source = changed.read_text()
    changed.write_text(source.replace('"""', '"""In other words: ', 1) + "# A remark.\n")
    assert diagnosing_sources.diagnosing_sources() == before
    changed.write_text(source + "REMARK = 1\n")
    assert diagnosing_sources.diagnosing_sources() != before


def test_an_entry_of_the_catalogue_is_no_part_of_a_law(tmp_path: Path) -> None:
    """A sentence or a prior of a mechanism costs no reduced model; its kernel does."""
    source = Path(mechanisms.__file__).with_name("solid_viscoelasticity.py").read_text()
    file, seen = tmp_path / "law.py", []
    for before, after in (
        ("", ""),
        ("statement=lambda v: (", "statement=lambda v: 'In short: ' + ("),
        ("0.2, 15.0", "0.3, 15.0"),
        ("past[:] = 0.0", "past[:] = 1.0"),
    ):
        assert before in source
        file.write_text(source.replace(before, after) if before else source)
        seen.append(law_source(file))
    assert seen[0] == seen[1] == seen[2] != seen[3]
