"""SVOX Pico by py-nanotts, run as a process of its own: request as JSON on standard input, samples out.

The engine keeps state between utterances; a fresh process makes every utterance reproducible.
"""

import json
import sys

import py_nanotts


def main() -> None:
    request = json.load(sys.stdin)
    samples = py_nanotts.NanoTTS().speak(
        request["text"], voice=request["voice"], speed=request["rate"], pitch=request["pitch"]
    )
    sys.stdout.buffer.write(json.dumps({"rate": 16000}).encode() + b"\n" + samples)


if __name__ == "__main__":
    main()
