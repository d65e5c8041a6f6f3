"""Sentences of the documentation and of docstrings are short."""

from __future__ import annotations

from tests.sentences import every_sentence, n_words, sentences


def test_no_sentence_has_more_than_thirty_words():
    found = [(place, s) for place, s in every_sentence() if n_words(s) > 30]
    assert [(place, s) for place, s in found if not place.startswith("experiments/")] == []


def test_what_counts_as_a_sentence():
    page = "# A title\n\nOne short sentence here. Another one is here (`a b c`):\n\n- an item of a list\n"
    page += "\n```python\nx = 1 + 2\n```\n"
    assert list(sentences(page)) == [
        "One short sentence here.",
        "Another one is here (`a b c`):",
        "an item of a list",
    ]
    assert n_words("Another one (`a b c`), with $a + b$ and [.1, .2] and 3.5 m") == 10
