"""The texts below the attributes of a class, read from its source.

pydantic can make them descriptions of the fields while it builds the class. That parses the source
of every table at every start, a third of the time that loading the configuration takes; the texts
are needed only where keys are explained.
"""

import ast
import inspect
import sys
from functools import cache

from pydantic import BaseModel


@cache
def list_attribute_texts(section: type) -> dict[str, str]:
    """Return the text below each annotated attribute of a class and of its own bases.

    A class whose source is not at hand has no texts.
    """
    texts: dict[str, str] = {}
    bases = [each for each in section.__mro__ if each not in BaseModel.__mro__]
    for each in reversed(bases):
        definition = _list_classes(each.__module__).get(each.__name__)
        if definition is not None:
            texts.update(_read_texts(definition))
    return texts


@cache
def _list_classes(module_name: str) -> dict[str, ast.ClassDef]:
    """Return the classes of a module by name."""
    try:
        source = inspect.getsource(sys.modules[module_name])
    except (KeyError, OSError, TypeError):
        return {}
    return {each.name: each for each in ast.parse(source).body if isinstance(each, ast.ClassDef)}


def _read_texts(definition: ast.ClassDef) -> dict[str, str]:
    """Return the texts of the annotated attributes that have one directly below."""
    texts = {}
    for above, below in zip(definition.body, definition.body[1:], strict=False):
        if not isinstance(above, ast.AnnAssign) or not isinstance(above.target, ast.Name):
            continue
        if not isinstance(below, ast.Expr) or not isinstance(below.value, ast.Constant):
            continue
        if isinstance(below.value.value, str):
            texts[above.target.id] = inspect.cleandoc(below.value.value)
    return texts
