"""Nothing that saclab reads can run code: no module of it unpickles, evaluates or loads anything that could."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[2] / "src"

# Modules that run what they read, or read what runs.
MODULES = {
    "_pickle", "cPickle", "cloudpickle", "code", "codeop", "dill", "joblib", "jsonpickle", "marshal", "pickle",
    "pickletools", "pickle5", "runpy", "ruamel", "shelve", "torch", "yaml",
}  # fmt: skip
FUNCTIONS = {"eval", "exec", "compile", "execfile", "__import__"}
METHODS = {"read_pickle", "to_pickle", "load_pickle"}


def offences(source: str) -> list[str]:
    """What a module must not do, each with its line."""
    found = []
    for node in ast.walk(ast.parse(source)):
        for offence in offences_of(node):
            found.append(f"line {getattr(node, 'lineno', 0)}: {offence}")
    return found


def offences_of(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [f"import {name.name}" for name in node.names if name.name.split(".")[0] in MODULES]
    if isinstance(node, ast.ImportFrom):
        module = (node.module or "").split(".")[0]
        names = [name.name for name in node.names if name.name in FUNCTIONS | METHODS or name.name in MODULES]
        return [f"from {node.module} import …"] * (module in MODULES) + [f"import {name}" for name in names]
    if isinstance(node, ast.Name) and node.id in FUNCTIONS:
        return [node.id]
    if isinstance(node, ast.Attribute) and node.attr in (FUNCTIONS | METHODS) - {"compile"}:  # re and JAX have one
        return [f".{node.attr}"]
    if isinstance(node, ast.keyword) and node.arg in ("allow_pickle", "pickle_module") and not is_false(node.value):
        return [f"{node.arg}="]
    if isinstance(node, ast.Call):
        return offences_of_call(node)
    return []


def offences_of_call(node: ast.Call) -> list[str]:
    """Loaders that unpickle unless they are told not to, a process through a shell, and imports by a computed name."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    owner = node.func.value.id if isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name) else ""
    if owner in ("np", "numpy", "jnp") and name == "load" and len(node.args) > 2:
        return [f"{owner}.load with positional allow_pickle"]
    if owner == "os" and name in ("system", "popen"):
        return [f"os.{name}"]
    if any(keyword.arg == "shell" and not is_false(keyword.value) for keyword in node.keywords):
        return ["shell="]
    return []


def is_false(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is False


@pytest.mark.parametrize("path", sorted(SOURCES.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCES)))
def test_no_module_can_run_what_it_reads(path):
    assert offences(path.read_text()) == []


def test_there_are_modules_to_look_at():
    assert len(list(SOURCES.rglob("*.py"))) > 40


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import os, pickle as innocent",
        "def f():\n    import cloudpickle",
        "from pickle import loads",
        "from _pickle import loads",
        "import marshal",
        "import shelve",
        "import dill",
        "import joblib",
        "from joblib import load",
        "import yaml",
        "from yaml import safe_load",
        "import ruamel.yaml",
        "import torch",
        "from torch import load",
        "torch.load(path, pickle_module=p)",
        "eval('1')",
        "x = eval",
        "exec(text)",
        "import builtins\nbuiltins.exec(text)",
        "from builtins import eval as harmless",
        "compile(text, 'f', 'exec')",
        "__import__(name)",
        "np.load(path, allow_pickle=True)",
        "np.load(path, None, True)",
        "numpy.load(path, allow_pickle=allow)",
        "arrays = dict(allow_pickle=True)",
        "pandas.read_pickle(path)",
        "os.system(text)",
        "subprocess.run(text, shell=True)",
        "import runpy",
    ],
)
def test_each_of_these_is_found(source):
    assert offences(source), source


@pytest.mark.parametrize(
    "source",
    [
        "import json\njson.loads(text)",
        "np.load(path, allow_pickle=False)",
        "import re\nre.compile('a')",
        "import safetensors.numpy\nsafetensors.numpy.load(content)",
        "subprocess.Popen([sys.executable])",
        "# pickle\n'eval'",
    ],
)
def test_none_of_these_is(source):
    assert offences(source) == []
