"""Write manual pages and completions for bash, zsh and fish from the commands.

    python packaging/manual.py FOLDER

writes FOLDER/man1/*.1 and FOLDER/{bash,zsh,fish}/. Completions are plain text: pressing Tab does
not start Python, which would take seconds on a Raspberry Pi. The date is that of SOURCE_DATE_EPOCH,
so that the same source gives the same bytes.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from commands import NAME, Command, Entry, program

from thermocald import __version__

_GROFF = str.maketrans({"\\": r"\e", "-": r"\-", "'": r"\(aq", "`": r"\(ga", "^": r"\(ha"})


def main(folder: Path) -> None:
    """Write everything into folder."""
    commands = list(program().walk())
    for command in commands:
        _write(folder / "man1" / f"{_page(command)}.1", man_page(command, commands))
    _write(folder / "bash" / NAME, bash(commands))
    _write(folder / "zsh" / f"_{NAME}", zsh(commands))
    _write(folder / "fish" / f"{NAME}.fish", fish(commands))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _page(command: Command) -> str:
    return "-".join(command.path)


def _roff(text: str) -> str:
    """Return text in groff's syntax; no line begins with a control character."""
    escaped = text.translate(_GROFF)
    return rf"\&{escaped}" if escaped.startswith(".") else escaped


def man_page(command: Command, commands: list[Command]) -> str:
    """Return a command's manual page, of section 1."""
    now = time.gmtime(int(os.environ.get("SOURCE_DATE_EPOCH", time.time())))
    date = time.strftime("%Y-%m-%d", now)
    words = " ".join(command.path)
    lines = [
        f'.TH {_page(command).upper()} 1 "{date}" "{NAME} {__version__}" "User Commands"',
        ".SH NAME",
        rf"{_roff(_page(command))} \- {_roff(command.summary)}",
        ".SH SYNOPSIS",
        rf".B {_roff(words)}",
        _roff(command.usage.removeprefix(words).strip()),
        ".SH DESCRIPTION",
    ]
    for paragraph in command.paragraphs:
        lines += [".PP", _roff(paragraph)]
    for title, entries in (("ARGUMENTS", command.arguments), ("OPTIONS", command.options)):
        if entries:
            lines.append(f".SH {title}")
        for entry in entries:
            lines += [".TP", rf".B {_roff(entry.term)}", _roff(entry.text)]
    if command.children:
        lines.append(".SH COMMANDS")
        for child in command.children:
            lines += [".TP", rf".BR {_roff(_page(child))} (1)", _roff(child.summary)]
    if len(command.path) == 1:
        lines += _PROGRAM_SECTIONS
    lines += [".SH SEE ALSO", _see_also(command, commands)]
    return "\n".join(lines) + "\n"


_PROGRAM_SECTIONS = [
    ".SH EXIT STATUS",
    "0 done, 1 the data do not allow it, 2 wrong usage or configuration, 3 a device failed.",
    ".SH FILES",
    ".TP",
    ".I /etc/thermocald/config.yaml",
    r"The daemon's configuration; that of the unit \fIthermocald@NAME\fR is",
    r"\fI/etc/thermocald/NAME.yaml\fR.",
    ".TP",
    ".I /var/lib/thermocald",
    "The store, the frames and the recordings of the daemon.",
]


def _see_also(command: Command, commands: list[Command]) -> str:
    above = [c for c in commands if c.path == command.path[:-1]]
    others = [c for c in commands if c.path[:-1] == command.path[:-1] and c is not command]
    pages = [_page(c) for c in (*above, *others)] or [_page(c) for c in command.children]
    return "\n".join(rf".BR {_roff(p)} (1)" for p in pages)


def _words(command: Command) -> list[str]:
    return [c.path[-1] for c in command.children] + [f for o in command.options for f in o.flags]


def _quoted(text: str) -> str:
    return "'" + text.replace("'", r"'\''") + "'"


def bash(commands: list[Command]) -> str:
    """Return a completion function for bash: subcommands and options, otherwise files."""
    cases = "\n".join(
        f"        {_quoted(' '.join(c.path[1:]))}) words={_quoted(' '.join(_words(c)))} ;;"
        for c in commands
    )
    groups = "|".join(_quoted(" ".join(c.path[1:])) for c in commands if len(c.path) > 1)
    choices = "\n".join(
        f"        {_quoted(' '.join((*c.path[1:], flag)))}) "
        f'COMPREPLY=($(compgen -W {_quoted(" ".join(o.choices))} -- "$current")); return ;;'
        for c in commands
        for o in c.options
        for flag in o.flags
        if o.choices
    )
    return f"""# bash completion for {NAME}, made from its commands
_{NAME}() {{
    local current=${{COMP_WORDS[COMP_CWORD]}} previous=${{COMP_WORDS[COMP_CWORD - 1]}}
    local command= next word words=
    for word in "${{COMP_WORDS[@]:1:COMP_CWORD - 1}}"; do
        next="${{command:+$command }}$word"
        case "$next" in {groups}) command=$next ;; esac
    done
    case "$command $previous" in
{choices}
        *) ;;
    esac
    case "$command" in
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "$current"))
    [[ $current == -* ]] || COMPREPLY+=($(compgen -f -- "$current"))
}}
complete -o filenames -F _{NAME} {NAME}
"""


def zsh(commands: list[Command]) -> str:
    """Return a completion function for zsh, with the help of commands and options."""

    def described(word: str, text: str) -> str:
        return _quoted(f"{word}:{text}".replace("\n", " "))

    cases = []
    for c in commands:
        inner = " ".join(described(k.path[-1], k.summary) for k in c.children)
        options = " ".join(described(f, o.text) for o in c.options for f in o.flags)
        cases.append(
            f"        {_quoted(' '.join(c.path[1:]))}) inner=({inner}); options=({options}) ;;"
        )
    groups = "|".join(_quoted(" ".join(c.path[1:])) for c in commands if len(c.path) > 1)
    body = "\n".join(cases)
    return f"""#compdef {NAME}
# zsh completion for {NAME}, made from its commands
_{NAME}() {{
    local command= next word
    local -a inner options
    for word in "${{(@)words[2,CURRENT-1]}}"; do
        next="${{command:+$command }}$word"
        case "$next" in {groups}) command=$next ;; esac
    done
    case "$command" in
{body}
    esac
    if [[ $words[CURRENT] == -* ]]; then
        _describe -o option options
    else
        (( $#inner )) && _describe command inner
        _files
    fi
}}
_{NAME} "$@"
"""


def fish(commands: list[Command]) -> str:
    """Return completions for fish: one line for every word."""
    lines = [f"# fish completion for {NAME}, made from its commands"]
    for c in commands:
        seen = [f"__fish_seen_subcommand_from {word}" for word in c.path[1:]]
        names = " ".join(child.path[-1] for child in c.children)
        unseen = [f"not __fish_seen_subcommand_from {names}"] if names else []
        start = f"complete -c {NAME} -n {_quoted('; and '.join([*seen, *unseen]) or 'true')}"
        lines += [
            f"{start} -a {child.path[-1]} -d {_quoted(child.summary)}" for child in c.children
        ]
        lines += [f"{start} {_fish_option(option)}" for option in c.options]
    return "\n".join(lines) + "\n"


def _fish_option(option: Entry) -> str:
    names = " ".join(f"-l {f[2:]}" if f.startswith("--") else f"-s {f[1:]}" for f in option.flags)
    value = " -r" if option.takes_value else ""
    listed = f" -xa {_quoted(' '.join(option.choices))}" if option.choices else ""
    return f"{names}{value}{listed} -d {_quoted(option.text)}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
