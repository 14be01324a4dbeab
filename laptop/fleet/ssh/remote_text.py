"""Shows the output of a program on a robot as it comes."""

import codecs
from typing import IO, TextIO


def copy_text(source: IO[bytes], to: TextIO) -> None:
    """Write what comes from `source` to a stream until its end, a question without a line end at once.

    The stream is one of this process' own, which are guarded: a robot's text does not steer the terminal.
    """
    decoder = codecs.getincrementaldecoder("utf-8")("replace")
    while data := source.read1(4096):  # type: ignore[attr-defined]  # a BufferedReader
        to.write(decoder.decode(data))
        to.flush()
