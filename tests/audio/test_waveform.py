"""Sound files in and out, and what is refused."""

import numpy as np
import pytest
import soundfile

from meshanim.audio import Waveform, load_waveform, save_waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError


def tone(frequency, rate, seconds=0.5):
    return np.sin(2 * np.pi * frequency * np.arange(int(rate * seconds)) / rate).astype(np.float32)


@pytest.mark.parametrize("suffix", [".wav", ".flac", ".ogg", ".aiff"])
def test_formats_are_read_mixed_and_resampled(tmp_path, suffix):
    stereo = np.stack([tone(440, 8000), np.zeros(4000, np.float32)], axis=1)
    path = tmp_path / f"speech{suffix}"
    soundfile.write(path, stereo, 8000)
    waveform = load_waveform(path)
    assert waveform.rate == 16000
    assert len(waveform.samples) == 8000
    assert waveform.samples.dtype == np.float32
    inner = slice(1000, -1000)
    tolerance = 0.05 if suffix == ".ogg" else 2e-3
    np.testing.assert_allclose(waveform.samples[inner], 0.5 * tone(440, 16000)[inner], atol=tolerance)


def test_24_bit_stereo_8_khz(tmp_path):
    path = tmp_path / "speech.wav"
    soundfile.write(path, np.stack([tone(300, 8000)] * 2, axis=1), 8000, subtype="PCM_24")
    assert load_waveform(path).duration == pytest.approx(0.5)


def test_sound_of_a_container(tmp_path):
    """An .m4a, as phones and MEAD have them: AAC, which keeps a tone nearly as it is."""
    import av

    path = tmp_path / "tone.m4a"
    given = 0.5 * tone(440, 48000)
    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream("aac", rate=48000)
        stream.layout = "stereo"
        samples = np.stack([given, 0.5 * given])
        frame = av.AudioFrame.from_ndarray(samples, format="fltp", layout="stereo")
        frame.rate, frame.pts = 48000, 0
        for packet in (*stream.encode(frame), *stream.encode(None)):
            file.mux(packet)
    waveform = load_waveform(path, rate=None)
    assert waveform.rate == 48000
    assert waveform.duration == pytest.approx(0.5, abs=1024 / 48000)
    middle = slice(4096, 20000)
    read, expected = waveform.samples[middle], 0.75 * given[middle]
    assert np.corrcoef(read, expected)[0, 1] > 0.99
    assert np.abs(read).mean() == pytest.approx(np.abs(expected).mean(), rel=0.05)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FileFormatError, match=r"tone\.m4a cannot be read as sound"):
        load_waveform(path)


def test_own_rate_is_kept_on_request(tmp_path):
    path = tmp_path / "speech.wav"
    soundfile.write(path, tone(300, 44100), 44100)
    assert load_waveform(path, rate=None).rate == 44100


def test_save_and_load(tmp_path):
    waveform = Waveform(2 * tone(200, 16000), 16000)
    save_waveform(waveform, tmp_path / "speech.wav")
    again = load_waveform(tmp_path / "speech.wav")
    np.testing.assert_allclose(again.samples, np.clip(waveform.samples, -1, 1), atol=1e-4)
    with pytest.raises(FileFormatError):
        save_waveform(waveform, tmp_path / "speech.txt")
    with pytest.raises(FileFormatError):
        save_waveform(waveform, tmp_path / "missing" / "speech.wav")


def test_levelling():
    assert np.abs(Waveform(0.01 * tone(200, 16000), 16000).levelled().samples).max() == pytest.approx(0.7)
    silence = Waveform(np.zeros(100, np.float32), 16000)
    assert silence.levelled() is silence


def write_text(path):
    path.write_text("this is no sound")


def write_nothing(path):
    path.write_bytes(b"")


def write_truncated(path):
    soundfile.write(path, tone(200, 16000), 16000)
    path.write_bytes(path.read_bytes()[:20])


def write_half(path):
    soundfile.write(path, tone(200, 16000), 16000)
    path.write_bytes(path.read_bytes()[:16000])


@pytest.mark.parametrize("write", [write_text, write_nothing, write_truncated, write_half])
def test_files_that_are_no_sound(tmp_path, write):
    path = tmp_path / "speech.wav"
    write(path)
    with pytest.raises(FileFormatError, match=r"speech\.wav") as caught:
        load_waveform(path)
    assert "\n" not in str(caught.value)


def test_wavs_of_programs_that_stream_are_read(tmp_path):
    """They cannot know the length when they write it: all ones, or nothing."""
    path = tmp_path / "speech.wav"
    soundfile.write(path, tone(200, 16000), 16000)
    whole, known = load_waveform(path).samples, path.read_bytes()
    for length in (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f"):
        path.write_bytes(known[:4] + length + known[8:40] + length + known[44:])
        np.testing.assert_array_equal(load_waveform(path).samples, whole)


def test_a_rate_that_no_speech_has(tmp_path):
    soundfile.write(tmp_path / "speech.wav", tone(20, 16000), 100)
    with pytest.raises(FileFormatError, match="100 samples a second; expected at least 4000"):
        load_waveform(tmp_path / "speech.wav")


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(FileFormatError, match="not a file"):
        load_waveform(tmp_path / "nothing.wav")
    with pytest.raises(FileFormatError, match="not a file"):
        load_waveform(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_that_are_no_numbers(tmp_path, value):
    samples = tone(200, 16000)
    samples[77] = value
    with pytest.raises(ShapeError, match="sample 77"):
        Waveform(samples, 16000)
    soundfile.write(tmp_path / "speech.wav", samples, 16000, subtype="FLOAT")
    with pytest.raises(ShapeError, match=r"speech\.wav: sample 77"):
        load_waveform(tmp_path / "speech.wav")


def test_no_samples(tmp_path):
    soundfile.write(tmp_path / "speech.wav", np.zeros(0, np.float32), 16000)
    with pytest.raises(ShapeError, match="no samples"):
        load_waveform(tmp_path / "speech.wav")


def test_wrong_shapes_and_rates():
    with pytest.raises(ShapeError, match="shape"):
        Waveform(np.zeros((10, 2), np.float32), 16000)
    with pytest.raises(ShapeError, match="rate"):
        Waveform(np.zeros(10, np.float32), 0)
    with pytest.raises(OptionError, match="rate"):
        Waveform(np.zeros(10, np.float32), 16000).resampled(-1)
