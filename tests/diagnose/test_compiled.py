"""What is compiled calls compiled functions of its own file only: numba's cache looks at no other file for changes."""

import pkgutil
from importlib import import_module

from numba.core.dispatcher import Dispatcher

import aemd.diagnose


def test_no_compiled_function_calls_one_of_another_file():
    names = [found.name for found in pkgutil.walk_packages(aemd.diagnose.__path__, "aemd.diagnose.")]
    modules = [import_module(name) for name in names]
    compiled = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    abroad = [
        (function.py_func.__name__, name)
        for function in compiled
        for name in function.py_func.__code__.co_names
        if isinstance(other := function.py_func.__globals__.get(name), Dispatcher)
        and other.py_func.__code__.co_filename != function.py_func.__code__.co_filename
    ]

    assert len(compiled) > 5
    assert abroad == []
