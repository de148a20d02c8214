"""`graspd completion SHELL`: a script that makes a shell complete commands, options and choices.

Made of the parsers once; no Python is started when Tab is pressed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from shlex import quote

from daemon.commands.arguments import Parser
from daemon.commands.manual import help_of, value_of
from models import zoo

SHELLS = ("bash", "zsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "shell",
        choices=SHELLS,
        help='which shell: eval "$(graspd completion bash)", in zsh after compinit; '
        "graspd completion fish | source",
    )


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    lines = _fish if args.shell == "fish" else _bash
    sys.stdout.writelines(f"{line}\n" for line in lines(args.whole_parser()))
    return 0


def _bash(parser: Parser) -> Iterator[str]:
    """For bash, and for zsh, which can take what bash does. Where nothing is known: files."""
    every = list(_parsers(parser, ()))
    inner = [" ".join(words) for words, _ in every if words]
    yield '[ -z "$ZSH_VERSION" ] || { autoload -U +X bashcompinit && bashcompinit; }'
    yield "_graspd() {"
    yield "    local word=${COMP_WORDS[COMP_CWORD]} at='' known='' i"
    yield "    for ((i = 1; i < COMP_CWORD; i++)); do"
    yield '        case "$at ${COMP_WORDS[i]}" in'
    yield f"            {_either(name if ' ' in name else f' {name}' for name in inner)})"
    yield '                at="${at:+$at }${COMP_WORDS[i]}" ;;'
    yield "        esac"
    yield "    done"
    yield '    case "$at ${COMP_WORDS[COMP_CWORD-1]}" in'
    for words, each in every:
        for action in each.actions:
            if action.option_strings and action.nargs != 0:
                names = (f"{' '.join(words)} {name}" for name in action.option_strings)
                yield f"        {_either(names)}) known={quote(' '.join(_values(action)))} ;;"
    yield '        *) case "$at/$word" in'
    for words, each in every:
        options = [name for action in each.actions for name in action.option_strings]
        others = [
            value for action in each.actions if not action.option_strings
            for value in _values(action)
        ]  # fmt: skip
        yield f"            {quote(' '.join(words))}/-*) known={quote(' '.join(options))} ;;"
        yield f"            {quote(' '.join(words))}/*) known={quote(' '.join(others))} ;;"
    yield "        esac ;;"
    yield "    esac"
    yield '    COMPREPLY=($(compgen -W "$known" -- "$word"))'
    yield "}"
    yield "complete -o bashdefault -o default -F _graspd graspd"


def _fish(parser: Parser) -> Iterator[str]:
    for words, each in _parsers(parser, ()):
        seen = [f"__fish_seen_subcommand_from {word}" for word in words]
        if each.subparsers:
            seen.append(f"not __fish_seen_subcommand_from {' '.join(each.subparsers)}")
        start = f"complete -c graspd -n {quote('; and '.join(seen))}"
        for name, command in each.subparsers.items():
            yield f"{start} -f -a {name} -d {quote(command.description or '')}"
        for action in each.actions:
            if isinstance(action.choices, dict):
                continue
            values = f" -x -a {quote(' '.join(_values(action)))}" if _values(action) else ""
            if not action.option_strings:
                yield from [f"{start}{values}"] if values else []
                continue
            names = " ".join(
                f"-l {name[2:]}" if name.startswith("--") else f"-s {name[1:]}"
                for name in action.option_strings
            )
            needs = " -r" if action.nargs != 0 and not values else ""
            yield f"{start} {names}{needs}{values} -d {quote(help_of(action))}"


def _parsers(parser: Parser, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Parser]]:
    """This parser and those of all its commands, each with the words that lead to it."""
    yield words, parser
    for name, command in parser.subparsers.items():
        yield from _parsers(command, (*words, name))


def _values(action: argparse.Action) -> list[str]:
    """The words that an argument takes, as far as they are known."""
    if action.choices is not None:
        return [str(choice) for choice in action.choices]
    return zoo.names() if value_of(action) == "MODEL" else []


def _either(words: Iterable[str]) -> str:
    return "|".join(quote(word) for word in words)
