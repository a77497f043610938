"""Texts for people, made where they are shown: templates with optional parts."""

import re
from collections.abc import Mapping

_PART = re.compile(r"\[([^\]]*)\]")
_FIELD = re.compile(r"{(\w+)")


def for_people(text: str) -> str:
    """Return a text as people read it: `±` for `+-`, in one line."""
    return " ".join(text.replace("+-", "±").split())


def fields_of(template: str) -> frozenset[str]:
    """Return the names of the fields that a template mentions."""
    return frozenset(_FIELD.findall(template))


def fill_template(template: str, values: Mapping[str, object]) -> str | None:
    """Fill a template such as `Fault {name}: {cause}[ ({seen})]`.

    Parameters
    ----------
    template : str
        A part in brackets is left out if one of its fields has no value.
    values : mapping of str to object
        Values by field; None and an empty text count as no value.

    Returns
    -------
    str or None
        The sentence, which begins with a capital; None if a field outside brackets has no value.
    """
    known = {name: value for name, value in values.items() if value not in (None, "")}
    form = _PART.sub(lambda part: part[1] if fields_of(part[1]) <= known.keys() else "", template)
    if not fields_of(form) <= known.keys():
        return None
    sentence = for_people(form.format_map(known))
    return sentence[:1].upper() + sentence[1:]
