"""Check names and texts of the repository against docs/glossary.md and the lists in this folder.

    python tools/vocabulary.py            report what is refused; exit code 1 if anything is
    python tools/vocabulary.py --shrink   lower the numbers in both lists of exceptions to what is there today

Names: of files, classes, functions, parameters, fields, constants, YAML keys, commands and options. A name is split at
underscores, hyphens and capitals; each word must be in a term of docs/glossary.md or in words.txt. words_to_rename.txt
holds the words that are not allowed but still in use: word, number of uses, replacement.

Texts: docstrings, comments, strings and pages. They are searched for the patterns of constructions.txt;
constructions_baseline.txt holds how many matches a file may still have.

Numbers in both lists of exceptions can only fall: more uses than listed are refused, and `--shrink` raises no number.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

PACKAGES = ("tacsim", "calibration", "robot", "benchmarks", "tools")
CONFIGS = "configs"
PAGES = ("README.md", "CONTRIBUTING.md", "docs/*.md", "examples/*.py")
NOT_READ = ("tools/vocabulary.py", "docs/glossary.md")  # they name what is refused
COMMAND_FILES = ("robot/cli/", "benchmarks/command.py")
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
TERM = re.compile(r"^\| ([^|]+?) \|")  # the first column of a table of the glossary
OPTION = re.compile(r"--[a-z][a-z0-9-]*")


@dataclass(frozen=True)
class Name:
    """A name and where it is defined."""

    text: str
    place: str  # file:line


@dataclass(frozen=True)
class Construction:
    """A pattern that texts must not match, and what to write instead."""

    pattern: re.Pattern[str]
    advice: str


def split_words(name: str) -> list[str]:
    """The words of a name in lower case: `GelOverlap`, `gel_overlap` and `gel-overlap` have the same two.

    A single letter (`x`, `E`) is a symbol, not a word.
    """
    return [word.lower() for word in WORD.findall(name) if len(word) > 1]


def glossary_words(page: str) -> set[str]:
    """All words in the first column of the tables of the glossary."""
    terms = [match[1] for line in page.splitlines() if (match := TERM.match(line))]
    return {word.lower() for term in terms for word in re.findall(r"[A-Za-z]{2,}", term)}


def names_of_module(source: str, file: str) -> Iterator[Name]:
    """Names that a module defines, with its own; in modules of commands their names and options, too.

    Raises:
        SyntaxError: `source` is not Python.
    """
    tree = ast.parse(source, file)
    yield Name(Path(file.removesuffix("/__init__.py")).stem, f"{file}:1")
    for node in ast.walk(tree):
        for text, place in _defined(node):
            yield Name(text, f"{file}:{place.lineno}")
        if file.startswith(COMMAND_FILES):
            for text, place in _typed_by_users(node):
                yield Name(text, f"{file}:{place.lineno}")


def _typed_by_users(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Options and names of commands in one node."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and OPTION.match(node.value):
        yield from ((option, node) for option in OPTION.findall(node.value))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "command":
        yield from ((str(argument.value), node) for argument in node.args if isinstance(argument, ast.Constant))


def _defined(node: ast.AST) -> Iterator[tuple[str, ast.stmt | ast.expr | ast.arg]]:
    """Names that one node defines, each with the node to take the line from."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        yield node.name, node
    elif isinstance(node, ast.arg):
        yield node.arg, node
    if isinstance(node, ast.Module | ast.ClassDef):  # constants and fields
        for statement in node.body:
            targets: list[ast.expr] = []
            if isinstance(statement, ast.Assign):
                targets = statement.targets
            elif isinstance(statement, ast.AnnAssign):
                targets = [statement.target]
            for target in targets:
                yield from ((part.id, part) for part in ast.walk(target) if isinstance(part, ast.Name))


def names_of_yaml(source: str, file: str) -> Iterator[Name]:
    """The keys of a YAML file, nested ones included, and its name."""
    yield Name(Path(file).stem, f"{file}:1")
    waiting = [yaml.compose(source)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                for part in str(key.value).split("."):
                    yield Name(part, f"{file}:{key.start_mark.line + 1}")
                waiting.append(value)
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value


def texts_of_module(source: str) -> Iterator[tuple[int, str]]:
    """Docstrings, comments and other strings of a module, each with its first line; comments on lines of their own that
    follow one another are one text."""
    block: list[str] = []
    start = last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, alone = token.start[0], token.line.lstrip().startswith("#")
            if block and not (alone and row == last + 1):
                yield start, " ".join(block)
                block = []
            start, last = start if block else row, row if alone else -1
            block.append(token.string.lstrip("#: "))
        elif token.type == tokenize.STRING or token.type == getattr(tokenize, "FSTRING_MIDDLE", -1):
            yield token.start[0], token.string
    if block:
        yield start, " ".join(block)


def texts_of_page(source: str) -> Iterator[tuple[int, str]]:
    """The paragraphs of a page without its blocks of code, each with its first line."""
    start, lines, code = 1, list[str](), False
    for number, line in enumerate([*source.splitlines(), ""], 1):
        if line.startswith("```"):
            code = not code
        if line.strip() and not code and not line.startswith("```"):
            start = start if lines else number
            lines.append(line)
        elif lines:
            yield start, " ".join(lines)
            lines = []


def find_constructions(texts: Iterable[tuple[int, str]], refused: Sequence[Construction]) -> Iterator[tuple[int, str]]:
    """Line and message of each match of a refused construction; line breaks count as spaces."""
    anything = re.compile("|".join(f"(?:{each.pattern.pattern})" for each in refused) or "(?!)", re.IGNORECASE)
    for line, text in texts:
        flat = " ".join(text.split())
        if anything.search(flat):  # most texts match nothing, and one search is faster than one for each pattern
            for construction in refused:
                for match in construction.pattern.finditer(flat):
                    yield line, f'"{match[0]}": {construction.advice}'


def read_constructions(source: str) -> list[Construction]:
    """The list of constructions.txt: a pattern, a tab, and what to write instead."""
    rows = [line.split("\t") for line in source.splitlines() if line and not line.startswith("#")]
    return [Construction(re.compile(pattern, re.IGNORECASE), advice) for pattern, advice in rows]


def read_counts(source: str) -> dict[str, tuple[int, str]]:
    """A list of exceptions: entry, number, and what else stands in its line."""
    rows = [line.split("\t") for line in source.splitlines() if line and not line.startswith("#")]
    return {row[0]: (int(row[1]), "\t".join(row[2:])) for row in rows}


def lower_counts(source: str, found: Mapping[str, int]) -> str:
    """The list with each number lowered to what was found; an entry that was not found at all is left out."""
    lines = []
    for line in source.splitlines():
        if line and not line.startswith("#"):
            entry, number, *rest = line.split("\t")
            now = min(int(number), found.get(entry, 0))
            if now == 0:
                continue
            line = "\t".join((entry, str(now), *rest))
        lines.append(line)
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Vocabulary:
    """The names and texts of a checkout, and the lists that they are checked against."""

    root: Path

    def read(self, name: str) -> str:
        return (self.root / name).read_text(encoding="utf-8")

    def allowed_words(self) -> set[str]:
        return glossary_words(self.read("docs/glossary.md")) | set(self.read("tools/words.txt").split())

    def names(self) -> Iterator[Name]:
        for file in self._files(f"{package}/**/*.py" for package in PACKAGES):
            yield from names_of_module(self.read(file), file)
        for file in self._files([f"{CONFIGS}/**/*.yaml"]):
            yield from names_of_yaml(self.read(file), file)

    def texts(self) -> Iterator[tuple[str, Iterator[tuple[int, str]]]]:
        """Each file, and its texts."""
        for file in self._files([*(f"{package}/**/*.py" for package in PACKAGES), *PAGES, f"{CONFIGS}/**/*.yaml"]):
            if file not in NOT_READ:
                source = self.read(file)
                yield file, texts_of_module(source) if file.endswith(".py") else texts_of_page(source)

    def _files(self, patterns: Iterable[str]) -> list[str]:
        found = {path for pattern in patterns for path in self.root.glob(pattern) if path.is_file()}
        return sorted(path.relative_to(self.root).as_posix() for path in found if "__pycache__" not in path.parts)

    def unknown_words(self) -> dict[str, list[Name]]:
        """The names of each word that is not allowed."""
        allowed = self.allowed_words()
        unknown = defaultdict(list)
        for name in self.names():
            for word in dict.fromkeys(split_words(name.text)):
                if word not in allowed:
                    unknown[word].append(name)
        return unknown

    def refused_constructions(self) -> dict[str, list[tuple[int, str]]]:
        """Line and message of each refused construction, by file."""
        refused = read_constructions(self.read("tools/constructions.txt"))
        found = {file: list(find_constructions(texts, refused)) for file, texts in self.texts()}
        return {file: matches for file, matches in found.items() if matches}

    def problems(self) -> list[str]:
        """What is refused, one line each; empty where all is well."""
        return [*self._name_problems(), *self._text_problems()]

    def _name_problems(self) -> Iterator[str]:
        exceptions = read_counts(self.read("tools/words_to_rename.txt"))
        unknown = self.unknown_words()
        for word, names in sorted(unknown.items()):
            number, replacement = exceptions.get(word, (0, ""))
            if len(names) > number:
                uses = ", ".join(f"{name.text} ({name.place})" for name in names[:5])
                yield (
                    f'the word "{word}" is not allowed in names ({len(names)} uses, {number} allowed): {uses}; write '
                    + (
                        f"`{replacement}`"
                        if replacement
                        else "a term of docs/glossary.md (plain words: tools/words.txt)"
                    )
                )
        for word in sorted(exceptions.keys() - unknown.keys()):
            yield f'tools/words_to_rename.txt: "{word}" occurs in no name any more: run tools/vocabulary.py --shrink'

    def _text_problems(self) -> Iterator[str]:
        baseline = read_counts(self.read("tools/constructions_baseline.txt"))
        found = self.refused_constructions()
        for file, matches in sorted(found.items()):
            number = baseline.get(file, (0, ""))[0]
            if len(matches) > number:
                places = "; ".join(f"{file}:{line}: {message}" for line, message in matches)
                yield f"{file}: {len(matches)} refused constructions, {number} allowed: {places}"
        for file in sorted(baseline.keys() - found.keys()):
            yield f"tools/constructions_baseline.txt: {file} has none any more: run tools/vocabulary.py --shrink"

    def shrink(self) -> None:
        """Lowers the numbers of both lists of exceptions to what is there."""
        words = Counter({word: len(names) for word, names in self.unknown_words().items()})
        matches = Counter({file: len(found) for file, found in self.refused_constructions().items()})
        for name, found in (("words_to_rename", words), ("constructions_baseline", matches)):
            path = self.root / f"tools/{name}.txt"
            path.write_text(lower_counts(path.read_text(encoding="utf-8"), found), encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Check the words of names and texts.")
    parser.add_argument("--shrink", action="store_true", help="lower the numbers in the lists of exceptions")
    options = parser.parse_args(arguments)
    vocabulary = Vocabulary(Path(__file__).resolve().parent.parent)
    if options.shrink:
        vocabulary.shrink()
    problems = vocabulary.problems()
    sys.stderr.writelines(f"{problem}\n" for problem in problems)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
