//! Reduces the gain of a settling that oscillates because its voltage arrives late.

/// Least difference between two consecutive turning points of the voltage that counts as an
/// oscillation, V. With 0.4 V, the voltage of an arm that sticks and slips reduced the gain where
/// the gain was needed, and 4 of 3000 Qubes touched a stop at up to 8.5 rad/s; with 0.6 V, one did,
/// at 2.3 rad/s.
const LEAST_REVERSAL_V: f64 = 0.6;

/// Longest time between two consecutive turning points that counts as an oscillation, control
/// periods. Feedback that arrives late swings at 4 to 8 Hz, so that its voltage turns every 6 to 12
/// periods. A pendulum that hangs from a light arm swings at up to 2.9 Hz. A pendulum that whirls
/// at 25 rad/s reduces the gain, too; the gain that is left brings it to rest.
const LONGEST_HALF_PERIOD: u32 = 13;

/// Factor by which each turning point of an oscillation multiplies the gain.
const GAIN_FACTOR: f64 = 0.8;

/// Smallest gain, as a fraction of the full one. With 0.4, the linear loop of a strong motor on a
/// short and light arm (each 7 to 19 % off nominal) is stable at 22 ms of delay. With 0.25, a stiff
/// cable throws the arm off its stop.
const LEAST_GAIN: f64 = 0.4;

/// The factor on the gains of a feedback, at most 1, which falls while the voltage oscillates and
/// never rises again.
///
/// Gains that are firm enough for a weak motor on a heavy arm make a strong motor on a short and
/// light arm oscillate, if the voltage arrives 14 ms late or more. A feedback that oscillates has
/// more gain than it needs.
///
/// `safety`'s `RingingGain` does the same for a brake, by changes of the voltage's sign. The
/// voltage of settling swings about an offset, against a cable or ahead of the arm, and need not
/// change its sign; so this type counts turning points.
#[derive(Clone, Copy, Debug)]
pub struct OscillationGain {
    gain: f64,
    /// Voltage of the full gains farthest in the present direction since the last turning point, V;
    /// `None` before the first voltage.
    furthest_full_v: Option<f64>,
    /// 1 while the voltage rises, -1 while it falls, 0 before it has moved.
    direction: f64,
    periods_since_turn: u32,
}

impl Default for OscillationGain {
    fn default() -> Self {
        let periods_since_turn = LONGEST_HALF_PERIOD;
        Self { gain: 1.0, furthest_full_v: None, direction: 0.0, periods_since_turn }
    }
}

impl OscillationGain {
    /// Takes the voltage of the feedback with its full gains, V; returns the factor on the gains.
    pub fn update(&mut self, full_v: f64) -> f64 {
        self.periods_since_turn = self.periods_since_turn.saturating_add(1);
        let furthest_full_v = *self.furthest_full_v.get_or_insert(full_v);
        let moved_v = self.gain * (full_v - furthest_full_v);
        if moved_v * self.direction > 0.0 {
            self.furthest_full_v = Some(full_v);
        } else if moved_v.abs() >= LEAST_REVERSAL_V {
            if self.direction != 0.0 {
                if self.periods_since_turn <= LONGEST_HALF_PERIOD {
                    self.gain = (GAIN_FACTOR * self.gain).max(LEAST_GAIN);
                }
                self.periods_since_turn = 0;
            }
            self.furthest_full_v = Some(full_v);
            self.direction = moved_v.signum();
        }
        self.gain
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::qube::CONTROL_PERIOD_S;

    /// The gain after 2 s of a voltage that swings by `amplitude_v` to either side of 1 V, this
    /// many times a second.
    fn gain_after(frequency_hz: f64, amplitude_v: f64) -> f64 {
        let mut oscillation = OscillationGain::default();
        (0..200).fold(1.0, |_, period| {
            let phase = TAU * frequency_hz * f64::from(period) * CONTROL_PERIOD_S;
            oscillation.update(1.0 + amplitude_v * phase.sin())
        })
    }

    #[test]
    fn a_fast_swing_of_the_voltage_reduces_the_gain_and_a_slow_or_small_one_does_not() {
        for frequency_hz in [4.0, 5.0, 8.0] {
            assert_eq!(gain_after(frequency_hz, 5.0), LEAST_GAIN, "{frequency_hz} Hz");
        }
        for frequency_hz in [0.5, 1.0, 2.0, 2.5] {
            assert_eq!(gain_after(frequency_hz, 5.0), 1.0, "{frequency_hz} Hz");
        }
        assert_eq!(gain_after(5.0, 0.25), 1.0);
    }

    #[test]
    fn a_gain_that_fell_does_not_fall_again_while_the_voltage_stays() {
        let mut oscillation = OscillationGain::default();
        for full_v in [0.0, 4.0, -4.0, 4.0] {
            oscillation.update(full_v);
        }
        let fell = oscillation.update(4.0);
        assert_eq!(fell, GAIN_FACTOR);
        assert!((0..200).all(|_| oscillation.update(4.0) == fell));
    }
}
