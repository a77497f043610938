"""The texts of keys are those that pydantic itself would read."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from membrane_ctrl.config.attribute_texts import list_attribute_texts


class Plain(BaseModel):
    """Not a text of a key."""

    first: int = 1
    """About the
    first.
    """
    second: int = 2
    third: int = 3
    "About the third."

    def method(self) -> None:
        """Not a text of a key either."""


class Inherited(Plain):
    third: int = 4
    """Another text of the third."""
    fourth: int = 5


class Documented(BaseModel):
    model_config = ConfigDict(use_attribute_docstrings=True)
    first: int = 1
    """About the
    first.
    """
    second: int = 2
    third: int = 3
    "About the third."


def test_the_texts_are_those_of_pydantic() -> None:
    fields = Documented.model_fields.items()
    of_pydantic = {name: field.description for name, field in fields if field.description}
    assert (
        list_attribute_texts(Plain)
        == of_pydantic
        == {
            "first": "About the\nfirst.",
            "third": "About the third.",
        }
    )


def test_a_class_has_the_texts_of_its_base_and_its_own_instead() -> None:
    assert list_attribute_texts(Inherited)["third"] == "Another text of the third."
    assert list_attribute_texts(Inherited)["first"] == "About the\nfirst."
    assert "fourth" not in list_attribute_texts(Inherited)


def test_a_class_without_source_has_no_texts() -> None:
    made = type("Made", (), {"__annotations__": {"first": int}, "__module__": "nowhere"})
    assert list_attribute_texts(made) == {}
