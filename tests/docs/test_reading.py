"""How pages are measured, on texts made for the purpose; and that the published pages keep the limits."""

from docs.contents import BELOW, CONTENTS
from docs.reading import DOCS, broken, check, measure, sentences

PAGE = """# A heading of many words that is no sentence

One sentence here. A [link](page.md) counts by its text, and `code` as one word.

| a table | with words |
|---|---|

```python
code = "is not read. Nor is this."
```

- A list item is a sentence of its own
"""


def test_only_prose_is_read():
    assert sentences(PAGE) == [
        "One sentence here.",
        "A link counts by its text, and Name as one word.",
        "A list item is a sentence of its own",
    ]


def test_the_longest_and_the_median_sentence_are_found():
    page = f"Short one here. Then {'word ' * 35}end. Another short one."
    found = measure(page)
    assert (found.median, found.longest) == (3, 37)
    assert found.words == len(page.split())
    assert len(broken("page", found)) == 1


def test_long_words_lower_the_reading_ease():
    hard = "Incomprehensible terminological considerations necessitate extraordinary interpretation."
    assert measure(hard).ease < 0 < measure("The cat sat on the mat.").ease
    assert "reading ease" in broken("page", measure(hard))[0]


def test_the_pages_keep_the_limits():
    assert check() == []


def test_each_page_is_in_the_contents_once():
    listed = ["index", *(page for own in (*CONTENTS.values(), *BELOW.values()) for page in own)]
    pages = {page.stem for page in DOCS.glob("*.md")} - {"changelog"}
    assert len(listed) == len(set(listed))
    assert pages <= set(listed)
