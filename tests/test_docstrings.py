"""Every public function says what it takes and gives: shapes, and errors where it raises them.

A function of one array says so in its summary: the shapes of what it takes and gives, in brackets.
One of several arrays has the sections Args and Returns, with each array and its shape, or says
whose they are: "Args: as `knn_distances`."
"""

import ast
import re
from pathlib import Path

import pytest

import maxent_jax

PACKAGE = Path(maxent_jax.__file__).parent
ARRAYS = re.compile(r"\b(Array|ndarray)\b")
SHAPE = re.compile(r"\[[^\]]*\]")
KEYS = re.compile(r"(key|rng)(_.*)?")  # of random numbers: typed keys, without a shape to tell


def public_functions(path):
    """The public functions of a module, and the public methods of its public classes."""
    for node in ast.parse(path.read_text()).body:
        members = [node]
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            members = node.body
        for member in members:
            if isinstance(member, ast.FunctionDef) and not member.name.startswith("_"):
                yield member


def array_arguments(function):
    """The names of its arguments that are arrays, but for keys."""
    arguments = (*function.args.args, *function.args.kwonlyargs)
    annotated = [a for a in arguments if a.annotation is not None]
    arrays = [a.arg for a in annotated if ARRAYS.search(ast.unparse(a.annotation))]
    return [name for name in arrays if not KEYS.fullmatch(name)]


def section(docstring, name):
    """The lines of a section, "" without one."""
    found = re.search(rf"^{name}:\n((?:[ ]+.*\n?|\n)+)", docstring, re.MULTILINE)
    return found[1] if found else ""


def raises(function):
    """Whether it raises an exception itself."""
    inner = {
        node
        for nested in ast.walk(function)
        if isinstance(nested, ast.FunctionDef | ast.Lambda) and nested is not function
        for node in ast.walk(nested)
    }
    return any(isinstance(n, ast.Raise) and n.exc for n in ast.walk(function) if n not in inner)


FUNCTIONS = [
    pytest.param(function, id=f"{path.relative_to(PACKAGE)}:{function.name}")
    for path in sorted(PACKAGE.rglob("*.py"))
    for function in public_functions(path)
]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_public_function_says_what_it_takes_gives_and_raises(function):
    docstring = (ast.get_docstring(function) or "") + "\n"
    arrays = array_arguments(function)
    lacking = []
    if raises(function) and "Raises" not in docstring and "raises" not in docstring:
        lacking.append("Raises")
    if len(arrays) == 1 and not (SHAPE.search(docstring) or section(docstring, "Args")):
        lacking.append(f"the shape of {arrays[0]}")
    if len(arrays) > 1 and not re.search(r"^Args: as `[\w.]+`", docstring, re.MULTILINE):
        takes, gives = section(docstring, "Args"), section(docstring, "Returns")
        for name in arrays:
            own = re.search(rf"^ *(?:\w+, )*{name}(?:, \w+)*: (?:[^\n]|\n {{4,}})*", takes, re.M)
            if not (own and SHAPE.search(own[0])):
                lacking.append(f"{name} with its shape, in Args")
        gives_something = function.returns is not None and ast.unparse(function.returns) != "None"
        if gives_something and not gives:
            lacking.append("Returns")
    assert not lacking, f"{function.name} lacks: {', '.join(lacking)}"
