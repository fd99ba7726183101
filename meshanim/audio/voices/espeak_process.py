"""espeak-ng by ctypes, run as a process of its own: request as JSON on standard input, answer out.

The library keeps its oscillators and random numbers between calls; a fresh process makes every utterance
reproducible, and safe beside threads and forks.
"""

import ctypes
import json
import sys

import espeakng_loader

EVENTS_AND_IPA = 3
SYNCHRONOUS = 2
RATE, PITCH, RANGE = 1, 3, 4
LIST_END, PHONEME = 0, 7


class EventId(ctypes.Union):
    _fields_ = [("number", ctypes.c_int), ("name", ctypes.c_char_p), ("string", ctypes.c_char * 8)]


class Event(ctypes.Structure):
    _fields_ = [
        ("type", ctypes.c_int),
        ("unique_identifier", ctypes.c_uint),
        ("text_position", ctypes.c_int),
        ("length", ctypes.c_int),
        ("audio_position", ctypes.c_int),
        ("sample", ctypes.c_int),
        ("user_data", ctypes.c_void_p),
        ("id", EventId),
    ]


def main() -> None:
    request = json.load(sys.stdin)
    library = ctypes.CDLL(espeakng_loader.get_library_path())
    sample_rate = library.espeak_Initialize(
        SYNCHRONOUS, 0, espeakng_loader.get_data_path().encode(), EVENTS_AND_IPA
    )
    library.espeak_ng_SetRandSeed(ctypes.c_long(1))
    if sample_rate <= 0:
        sys.exit("espeak-ng does not start")
    if library.espeak_SetVoiceByName(request["voice"].encode()) != 0:
        sys.exit(f"espeak-ng has no voice {request['voice']}")
    text = request["text"].encode()
    if request["task"] == "pronounce":
        library.espeak_TextToPhonemes.restype = ctypes.c_char_p
        pointer = ctypes.c_char_p(text)
        ipa = []
        while pointer.value:
            ipa.append(library.espeak_TextToPhonemes(ctypes.byref(pointer), 1, 2).decode())
        sys.stdout.buffer.write(json.dumps({"ipa": " ".join(ipa)}).encode())
        return

    blocks: list[bytes] = []
    events: list[tuple[float, str]] = []

    def receive(samples, count, event):
        if samples and count > 0:
            blocks.append(ctypes.string_at(samples, 2 * count))
        k = 0
        while event[k].type != LIST_END:
            if event[k].type == PHONEME:
                symbol = bytes(event[k].id.string).split(b"\0")[0].decode("utf8", "replace")
                events.append((event[k].audio_position / 1000, symbol))
            k += 1
        return 0

    signature = ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.POINTER(Event)
    )
    callback = signature(receive)
    library.espeak_SetSynthCallback(callback)
    for parameter, value in ((RATE, request["rate"]), (PITCH, request["pitch"]), (RANGE, request["range"])):
        library.espeak_SetParameter(parameter, int(value), 0)
    library.espeak_Synth.argtypes = [
        ctypes.c_char_p,
        ctypes.c_size_t,
        ctypes.c_uint,
        ctypes.c_int,
        ctypes.c_uint,
        ctypes.c_uint,
        ctypes.c_void_p,
        ctypes.c_void_p,
    ]
    if library.espeak_Synth(text, len(text) + 1, 0, 1, 0, 1, None, None) != 0:
        sys.exit("espeak-ng does not speak")
    library.espeak_Synchronize()
    header = json.dumps({"rate": sample_rate, "events": events}).encode()
    sys.stdout.buffer.write(header + b"\n" + b"".join(blocks))


if __name__ == "__main__":
    main()
