"""`swarm completion`: a script with which bash and zsh complete commands: `eval "$(swarm completion)"`."""

import argparse

from laptop.cli.commands import COMMANDS, CommandGroup

HELP = "print a script with which bash or zsh complete commands"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Take no argument: bash and zsh read the same script."""
    del parser


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    del args
    print(script(), end="")
    return 0


def script() -> str:
    """Return the script: names of commands, then those of a group, then files."""
    groups = "".join(
        f'        {name}) words="{" ".join(each.commands)}" ;;\n'
        for name, each in COMMANDS.items()
        if isinstance(each, CommandGroup)
    )
    return f"""[ -n "$ZSH_VERSION" ] && autoload -U +X compinit bashcompinit && compinit && bashcompinit
_swarm() {{
    local words=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{" ".join(COMMANDS)}"
    elif [ "$COMP_CWORD" -eq 2 ]; then
        case "${{COMP_WORDS[1]}}" in
{groups}        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _swarm swarm
"""
