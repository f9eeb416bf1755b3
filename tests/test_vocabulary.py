"""tools/vocabulary.py: names use plain words and terms of the glossary, texts use plain sentences."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.vocabulary import (
    Vocabulary,
    find_constructions,
    names_of_module,
    names_of_yaml,
    read_constructions,
    read_counts,
    split_words,
    texts_of_module,
    texts_of_page,
)

ROOT = Path(__file__).resolve().parents[1]
MAX_TERMS = 120
# Of the dialect that the lists of exceptions retire: no hand may add them to the words that are allowed.
PRIVATE = (
    "told untold laid lay wear worn felt unfelt apart way believe believed borne hurried lame bettered "
    "foresight cling unfollowed followers anatomy quicken mend beside besides anew asked seen unseen "
    "shown astray aslant torn caught bearable hopeless forgotten restless dying sag sooner fluttering "
    "quickest eased lasting unweighed unshaded gentle lingering kept carried lifeline strangers rival "
    "survivors squashed spoilt sunk most least fewest badness flattest heaviest "
)
CONSTRUCTIONS = read_constructions((ROOT / "tools/constructions.txt").read_text(encoding="utf-8"))


@pytest.fixture
def vocabulary(tmp_path: Path) -> Vocabulary:
    """A checkout with one module and one configuration file that are in order."""
    files = {
        "docs/glossary.md": "| Term | Meaning |\n|---|---|\n| normal force | Force along the normal [N]. |\n",
        "tools/words.txt": "limit\nmax\nrig\ntacsim\n",
        "tools/words_to_rename.txt": "# head\ntold\t1\treported\n",
        "tools/constructions.txt": "\\bnobody\\b\tname the user\n",
        "tools/constructions_baseline.txt": "# head\n",
        "tacsim/limit.py": '"""Limits."""\n\nMAX_FORCE = 3.0  # [N]\n\n\ndef limit_force(told, x):\n    return x\n',
        "configs/rig.yaml": "max_force: 3\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    return Vocabulary(tmp_path)


def append(vocabulary: Vocabulary, name: str, text: str) -> None:
    path = vocabulary.root / name
    path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")


@pytest.mark.slow
def test_repository_has_no_problem() -> None:
    assert Vocabulary(ROOT).problems() == []


def test_glossary_has_at_most_120_terms() -> None:
    rows = [
        line.split("|")[1]
        for line in (ROOT / "docs/glossary.md").read_text(encoding="utf-8").splitlines()
        if line[:2] == "| "
    ]
    terms = [term.strip() for row in rows if row.strip() != "Term" for term in row.split(",")]
    assert len(terms) == len(set(terms)) <= MAX_TERMS


def test_word_list_is_sorted_and_holds_no_private_word() -> None:
    words = (ROOT / "tools/words.txt").read_text(encoding="utf-8").split()
    assert words == sorted(set(words))
    assert set(PRIVATE.split()) & Vocabulary(ROOT).allowed_words() == set()


def test_module_in_order_has_no_problem(vocabulary: Vocabulary) -> None:
    assert vocabulary.problems() == []


@pytest.mark.parametrize(
    ("file", "text", "word"),
    [
        ("tacsim/limit.py", "def cling(x):\n    pass\n", "cling"),
        ("tacsim/limit.py", "class LimitWay:\n    pass\n", "way"),
        ("tacsim/limit.py", "class Limit:\n    borne: float\n", "borne"),
        ("tacsim/limit.py", "HURRIED = 1\n", "hurried"),
        ("tacsim/limit.py", "def limit(*, felt):\n    pass\n", "felt"),
        ("configs/rig.yaml", "rig:\n  - {max_wear: 1}\n", "wear"),
    ],
)
def test_new_private_word_is_refused(vocabulary: Vocabulary, file: str, text: str, word: str) -> None:
    append(vocabulary, file, text)
    (problem,) = vocabulary.problems()
    assert f'the word "{word}" is not allowed in names' in problem
    assert f"({file}:" in problem


def test_file_name_and_option_are_names(vocabulary: Vocabulary) -> None:
    (vocabulary.root / "robot/cli").mkdir(parents=True)
    (vocabulary.root / "robot/cli/lame.py").write_text('limit = app.command("max-laid")(Option("--sag/--no-limit"))\n')
    words = {problem.split('"')[1] for problem in vocabulary.problems()}
    assert words == {"robot", "lame", "laid", "sag", "no"} - {"robot"}


def test_another_use_of_a_word_to_rename_is_refused(vocabulary: Vocabulary) -> None:
    append(vocabulary, "tacsim/limit.py", "def max_told(x):\n    pass\n")
    (problem,) = vocabulary.problems()
    assert "2 uses, 1 allowed" in problem
    assert "write `reported`" in problem


def test_word_to_rename_that_no_longer_occurs_is_reported_and_removed(vocabulary: Vocabulary) -> None:
    path = vocabulary.root / "tacsim/limit.py"
    path.write_text(path.read_text(encoding="utf-8").replace("told", "force"), encoding="utf-8")
    (problem,) = vocabulary.problems()
    assert 'words_to_rename.txt: "told"' in problem
    vocabulary.shrink()
    assert vocabulary.problems() == []
    assert read_counts(vocabulary.read("tools/words_to_rename.txt")) == {}
    assert vocabulary.read("tools/words_to_rename.txt").startswith("# head")


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("tacsim/limit.py", '\n\ndef rig():\n    """A limit that\n    nobody knows."""\n'),
        ("tacsim/limit.py", "# Nobody knows.\n"),
        ("tacsim/limit.py", "x = 'nobody knows'\n"),
        ("configs/rig.yaml", "# nobody knows\n"),
        ("docs/limit.md", "A limit that\nnobody knows.\n"),
    ],
)
def test_new_refused_construction_is_refused(vocabulary: Vocabulary, file: str, text: str) -> None:
    (vocabulary.root / file).touch()
    append(vocabulary, file, text)
    (problem,) = vocabulary.problems()
    assert problem.startswith(f"{file}: 1 refused constructions, 0 allowed")
    assert "name the user" in problem


def test_baseline_allows_its_number_and_shrinks(vocabulary: Vocabulary) -> None:
    append(vocabulary, "tacsim/limit.py", "# nobody\n")
    append(vocabulary, "tools/constructions_baseline.txt", "tacsim/limit.py\t2\n")
    assert vocabulary.problems() == []
    vocabulary.shrink()
    assert read_counts(vocabulary.read("tools/constructions_baseline.txt")) == {"tacsim/limit.py": (1, "")}
    append(vocabulary, "tacsim/limit.py", "x = 'nobody'\n")
    assert len(vocabulary.problems()) == 1
    vocabulary.shrink()  # raises no number
    assert len(vocabulary.problems()) == 1


@pytest.mark.parametrize(
    "text",
    [
        "what of it is not of the dashpot",
        "of a body that hardens nobody knows",
        "as it is told",
        "leads it to its start, after your yes",
        "is laid anew",
        "told beside the force",
        "a wish to zero the wrench",
        "the finer the slower",
        "whoever does a piece",
    ],
)
def test_sentence_of_the_review_is_refused(text: str) -> None:
    assert list(find_constructions([(1, text)], CONSTRUCTIONS))


@pytest.mark.parametrize(
    "text",
    [
        "Returns the normal force on each sensor (n,) [N].",
        "The error grows with the size of the elements.",
        "Write a recording next to the rig file, and confirm the motion at the terminal.",
    ],
)
def test_plain_sentence_is_allowed(text: str) -> None:
    assert list(find_constructions([(1, text)], CONSTRUCTIONS)) == []


def test_words_are_split_at_underscores_hyphens_and_capitals() -> None:
    assert split_words("TactileSDFMap") == ["tactile", "sdf", "map"]
    assert split_words("--max-load_x") == ["max", "load"]
    assert split_words("_MAX_LOAD2") == ["max", "load"]


def test_names_of_a_module_are_those_that_it_defines() -> None:
    source = "A = B = 1\nclass C(D):\n    e: int = f\n    def g(self, h, *i, j=1, **k): m = n\nlambda o: p\n"
    names = {name.text for name in names_of_module(source, "tacsim/q.py")}
    assert names == {"A", "B", "C", "e", "g", "self", "h", "i", "j", "k", "o", "q"}


def test_names_of_yaml_are_all_its_keys() -> None:
    names = {name.text for name in names_of_yaml("a: {b: 1}\nc: [{d.e: 2}, f]\n", "configs/g.yaml")}
    assert names == {"a", "b", "c", "d", "e", "g"}


def test_comment_lines_in_a_row_are_one_text() -> None:
    source = "# what\n# of it\nx = 1  # one\ny = 2  # two\n"
    assert list(texts_of_module(source)) == [(1, "what of it"), (3, "one"), (4, "two")]


def test_code_blocks_of_a_page_are_not_texts() -> None:
    page = "one\ntwo\n\n```\nnobody\n```\nthree\n"
    assert list(texts_of_page(page)) == [(1, "one two"), (7, "three")]
