"""Pronounceable words that name locks; a person types one to remove another person's lock."""

from collections.abc import Collection

_CONSONANTS = "bdfgklmnprstvz"
_VOWELS = "aeiou"
_SHAPE = (_CONSONANTS, _VOWELS, _CONSONANTS, _VOWELS, _CONSONANTS)
WORDS = len(_CONSONANTS) ** 3 * len(_VOWELS) ** 2  # number of different words


def make_word(number: int) -> str:
    """Return the pronounceable word with this number (modulo `WORDS`).

    Parameters
    ----------
    number : int

    Returns
    -------
    str
        Five letters, such as `bofak`.
    """
    letters = []
    for choice in _SHAPE:
        number, place = divmod(number, len(choice))
        letters.append(choice[place])
    return "".join(letters)


def distinct_word(word: str, taken: Collection[str]) -> str:
    """Return the word, or the next one in their order that is not taken.

    Parameters
    ----------
    word : str
        Empty: the first word.
    taken : collection of str
        At most `WORDS` - 1 words.

    Returns
    -------
    str
    """
    if word and word not in taken:
        return word
    number = 0
    while (candidate := make_word(number)) in taken:
        number += 1
    return candidate
