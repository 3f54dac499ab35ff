use crate::qube::limited_to;

/// Largest time between two changes of the voltage's sign that counts as ringing, in control
/// periods. Ringing is the oscillation of a brake whose voltage arrives late. Its period is four
/// delays, at most 0.18 s, and the sign changes twice in a period. A hanging pendulum swings with a
/// period of 0.5 s.
const RINGING_PERIODS: u32 = 9;

/// Smallest amplitude that counts as ringing, V; below it the voltage is the noise of an arm at
/// rest.
const LEAST_V: f64 = 1.0;

/// Factor by which each change of sign that counts as ringing multiplies the gain.
const GAIN_FACTOR: f64 = 0.8;

/// Smallest gain, as a fraction of the full gain. With it the strongest motor on the lightest arm
/// within 30 % of a nominal Qube's does not ring at 20 ms of delay.
const LEAST_GAIN: f64 = 0.12;

/// The factor on a brake's gains, at most 1, which falls while the brake rings.
///
/// A brake that is firm enough for a weak motor with a heavy arm rings on a strong motor with a
/// light arm, because its voltage arrives late. A brake that rings has more gain than it needs, so
/// a smaller gain is still firm: each change of sign that counts as ringing lowers the gain, until
/// the loop no longer rings or the gain is [`LEAST_GAIN`]. `examples/braked_qubes.rs` counts the
/// Qubes that come to rest with this factor and without it.
#[derive(Clone, Copy, Debug)]
pub(super) struct RingingGain {
    gain: f64,
    is_positive: bool,
    periods_since_change: u32,
    largest_since_v: f64,
    /// Largest voltage of the plant, V.
    largest_v: f64,
}

impl RingingGain {
    /// The full gain, for a plant with this largest voltage, V.
    pub fn full(largest_v: f64) -> Self {
        Self {
            largest_v,
            gain: 1.0,
            is_positive: false,
            periods_since_change: RINGING_PERIODS,
            largest_since_v: 0.0,
        }
    }

    /// Scales and limits the voltage that the brake requests, V. Ringing reduces the gain.
    pub fn voltage_v(&mut self, wanted_v: f64) -> f64 {
        self.scaled_v(wanted_v, |gain| (GAIN_FACTOR * gain).max(LEAST_GAIN))
    }

    /// Scales and limits the voltage that the brake requests, V. Ringing leaves the gain as it is.
    pub fn voltage_at_same_gain_v(&mut self, wanted_v: f64) -> f64 {
        self.scaled_v(wanted_v, |gain| gain)
    }

    /// Scales and limits a voltage, V. Each change of sign that counts as ringing changes the gain
    /// by `on_ringing`.
    fn scaled_v(&mut self, wanted_v: f64, on_ringing: fn(f64) -> f64) -> f64 {
        let voltage_v = limited_to(self.gain * wanted_v, self.largest_v);
        self.periods_since_change = self.periods_since_change.saturating_add(1);
        let is_positive = voltage_v > 0.0;
        if is_positive != self.is_positive {
            let rings =
                self.periods_since_change <= RINGING_PERIODS && self.largest_since_v >= LEAST_V;
            if rings {
                self.gain = on_ringing(self.gain);
            }
            (self.is_positive, self.periods_since_change) = (is_positive, 0);
            self.largest_since_v = 0.0;
        }
        self.largest_since_v = self.largest_since_v.max(voltage_v.abs());
        voltage_v
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::MAX_VOLTAGE_V;

    /// The gain after a second of a voltage that alternates with this period, in control periods,
    /// and this amplitude, V.
    fn gain_after(period: u32, amplitude_v: f64) -> f64 {
        let mut ringing = RingingGain::full(MAX_VOLTAGE_V);
        for tick in 0..100 {
            let positive = tick % period < period / 2;
            ringing.voltage_v(if positive { amplitude_v } else { -amplitude_v });
        }
        ringing.gain
    }

    #[test]
    fn a_voltage_that_rings_loses_gain_and_one_that_follows_the_pendulum_does_not() {
        assert_eq!(gain_after(50, 5.0), 1.0);
        assert_eq!(gain_after(10, 0.5), 1.0);
        assert_eq!(gain_after(10, 50.0), LEAST_GAIN);
    }

    #[test]
    fn a_gain_that_may_not_fall_stays() {
        let mut ringing = RingingGain::full(MAX_VOLTAGE_V);
        for tick in 0..100 {
            let wanted_v = if tick % 8 < 4 { 9.0 } else { -9.0 };
            let voltage_v = ringing.voltage_at_same_gain_v(wanted_v);
            assert_eq!(voltage_v.abs(), MAX_VOLTAGE_V);
        }
    }
}
