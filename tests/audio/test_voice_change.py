import numpy as np
import pytest

from meshanim.audio import Waveform, log_mel, pitch
from meshanim.audio.voice_change import change_voice, stretch_time
from meshanim.errors import OptionError

RATE = 16000


def vowel(seconds=1.5, frequency=140.0, formants=(700, 1200), rate=RATE):
    """Pulses through two resonances, loud and soft in turn."""
    time = np.arange(int(seconds * rate)) / rate
    harmonics = np.arange(1, int(6000 / frequency))
    gain = sum(np.exp(-(((harmonics * frequency - f) / 200) ** 2)) for f in formants) + 0.01
    wave = (gain[:, None] * np.cos(2 * np.pi * harmonics[:, None] * frequency * time)).sum(0)
    loud = 0.3 + 0.7 * np.square(np.sin(2 * np.pi * 2 * time))
    return Waveform((0.05 * wave * loud).astype(np.float32), rate)


def envelope_peak(waveform, low, high):
    spectrum = np.abs(np.fft.rfft(waveform.samples * np.hanning(len(waveform.samples)))) ** 2
    frequency = np.fft.rfftfreq(len(waveform.samples), 1 / waveform.rate)
    inside = (frequency > low) & (frequency < high)
    return float(np.sum(frequency[inside] * spectrum[inside]) / np.sum(spectrum[inside]))


@pytest.mark.parametrize("rate", [16000, 44100])
@pytest.mark.parametrize("semitones", [-5.0, 3.0])
def test_the_pitch_moves_and_nothing_else(semitones, rate):
    before = vowel(rate=rate)
    after = change_voice(before, semitones)
    assert len(after.samples) == len(before.samples)
    f0 = pitch(after, 50)
    assert np.median(f0[f0 > 0]) == pytest.approx(140 * 2 ** (semitones / 12), rel=0.02)
    # The formants stay: the centre of the first resonance moves by less than half a harmonic.
    assert abs(envelope_peak(after, 400, 950) - envelope_peak(before, 400, 950)) < 0.5 * 140 * 2 ** (3 / 12)


def test_loud_and_soft_stay_where_they_are():
    before, after = vowel(), change_voice(vowel(), -4, 1.1)
    a, b = (log_mel(w).mean(1).numpy() for w in (before, after))
    shift = [np.corrcoef(a[10:-10], np.roll(b, k)[10:-10])[0, 1] for k in range(-5, 6)]
    assert int(np.argmax(shift)) == 5
    assert max(shift) > 0.95


def test_a_shorter_tract_has_higher_formants():
    before, after = vowel(), change_voice(vowel(), 0, 1.25)
    f0 = pitch(after, 50)
    assert np.median(f0[f0 > 0]) == pytest.approx(140, rel=0.01)
    moved = envelope_peak(after, 500, 1200) / envelope_peak(before, 400, 950)
    assert 1.12 < moved < 1.35


def test_no_change_is_none_and_silence_stays_silent():
    before = vowel()
    np.testing.assert_array_equal(change_voice(before).samples, before.samples)
    silent = change_voice(Waveform(np.zeros(8000, np.float32), RATE), 3, 1.1)
    assert np.abs(silent.samples).max() == 0


def test_stretching_keeps_the_pitch():
    wave = vowel()
    for count in (len(wave.samples) // 2, 2 * len(wave.samples)):
        out = Waveform(stretch_time(wave.samples.astype(float), count, RATE).astype(np.float32), RATE)
        assert len(out.samples) == count
        f0 = pitch(out, 50)
        assert np.median(f0[f0 > 0]) == pytest.approx(140, rel=0.02)


def test_bad_options_are_named():
    with pytest.raises(OptionError, match="13"):
        change_voice(vowel(), 13.0)
    with pytest.raises(OptionError, match="2"):
        change_voice(vowel(), 0.0, 2.0)
    with pytest.raises(OptionError, match="factor"):
        stretch_time(np.zeros(100), 1000, RATE)
