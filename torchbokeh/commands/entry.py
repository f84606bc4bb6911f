"""Where the command begins: before anything that takes a while is imported."""

from collections.abc import Sequence

from torchbokeh.commands.signals import end_while_importing


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, see `torchbokeh.commands.main.main`."""
    end_while_importing()
    from torchbokeh.commands.main import main as run

    return run(argv)
