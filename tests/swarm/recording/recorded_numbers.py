"""A recording's file whose messages have numbers: which of them it holds."""

from swarm.recording.reader import RecordingReader

TOPIC = "swarm/r0/x"


def numbers(path):
    reader = RecordingReader(path)
    return [sample.message["i"] for sample in reader.samples()], reader
