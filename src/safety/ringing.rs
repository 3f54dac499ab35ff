use crate::qube::MAX_VOLTAGE_V;

/// A voltage that changes its sign sooner than this after it did so before goes to and fro with the delay of
/// the loop and not with a swing of the pendulum, in control periods. Ringing has periods of four delays, at most
/// 0.18 s; a hanging pendulum's is 0.5 s.
const TO_AND_FRO_PERIODS: u32 = 9;

/// Only a voltage that was so large in between counts: less is noise of an arm at rest, V.
const LEAST_V: f64 = 1.0;

/// The share of its gain that a brake keeps each time it rings.
const KEPT_SHARE: f64 = 0.8;

/// The gain does not fall below this share: with it, the strongest motor on the lightest arm within 30 % of a
/// nominal Qube's does not ring through 20 ms of delay.
const LEAST_GAIN: f64 = 0.12;

/// The share of its gain that a brake keeps: less each time its voltage rings.
///
/// A brake firm enough for a weak motor with a heavy arm rings on a strong motor with a light one, because its
/// voltage comes late. What rings has more gain than it needs, so a little less stays firm: the product of gain,
/// delay and the motor's acceleration stays near the largest that does not ring, whatever the Qube.
/// `examples/braked_qubes.rs` counts how many Qubes come to rest with it and without.
#[derive(Clone, Copy, Debug)]
pub(super) struct RingingGain {
    gain: f64,
    is_positive: bool,
    periods_since_change: u32,
    largest_since_v: f64,
}

impl Default for RingingGain {
    fn default() -> Self {
        Self {
            gain: 1.0,
            is_positive: false,
            periods_since_change: TO_AND_FRO_PERIODS,
            largest_since_v: 0.0,
        }
    }
}

impl RingingGain {
    /// The voltage of a brake that wants this one, V; `may_fall` is whether ringing costs gain yet.
    pub fn voltage_v(&mut self, wanted_v: f64, may_fall: bool) -> f64 {
        let voltage_v = (self.gain * wanted_v).clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V);
        self.periods_since_change = self.periods_since_change.saturating_add(1);
        let is_positive = voltage_v > 0.0;
        if is_positive != self.is_positive {
            let rings =
                self.periods_since_change <= TO_AND_FRO_PERIODS && self.largest_since_v >= LEAST_V;
            if rings && may_fall {
                self.gain = (KEPT_SHARE * self.gain).max(LEAST_GAIN);
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

    /// The gain after a second of a voltage that goes to and fro with this period and amplitude.
    fn gain_after(period: u32, amplitude_v: f64) -> f64 {
        let mut ringing = RingingGain::default();
        for tick in 0..100 {
            let positive = tick % period < period / 2;
            ringing.voltage_v(if positive { amplitude_v } else { -amplitude_v }, true);
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
        let mut ringing = RingingGain::default();
        for tick in 0..100 {
            let wanted_v = if tick % 8 < 4 { 9.0 } else { -9.0 };
            let voltage_v = ringing.voltage_v(wanted_v, false);
            assert_eq!(voltage_v.abs(), MAX_VOLTAGE_V);
        }
    }
}
