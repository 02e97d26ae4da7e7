"""README's figures: each is in docs/data, and one that is not is found."""

import re

import pytest

from scripts import front_page

README = (front_page.ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def stated():
    return front_page.sentences(front_page.ROOT / "docs" / "data")


def test_every_figure_of_the_front_page_is_in_the_data(stated):
    text = front_page.words(README)
    assert not [sentence for sentence in stated if sentence not in text]
    assert not front_page.unexplained(README, stated)


@pytest.mark.parametrize("page", ["README.md", "docs/performance.md"])
def test_the_table_of_rates_is_that_of_the_data(page):
    text = (front_page.ROOT / page).read_text(encoding="utf-8")
    begin, end = (f"<!-- {front_page.MARK}:{what} -->" for what in ("begin", "end"))
    [shown] = re.findall(f"{begin}\n\n(.*?)\n\n{end}", text, re.S)
    assert shown == front_page.table(front_page.ROOT / "docs" / "data")


@pytest.mark.parametrize(
    "right, wrong",
    [
        ("29 of 30 runs", "28 of 30 runs"),  # another figure
        ("3.6 %", "3.5 %"),  # rounded wrongly
        ("## Licence", "It is 17 times as fast.\n\n## Licence"),  # one that nothing explains
        ("with CUDA 13", "with CUDA 14"),  # not one of the names
    ],
)
def test_a_figure_that_is_not_in_the_data_is_found(right, wrong, stated):
    assert right in README
    planted = README.replace(right, wrong)
    lost = [sentence for sentence in stated if sentence not in front_page.words(planted)]
    assert front_page.unexplained(planted, stated) and (lost or right.startswith(("##", "with")))
