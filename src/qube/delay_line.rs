#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use crate::elementary::Scalar;

use super::{BLOCK, CONTROL_PERIOD_S, Lanes, MAX_HISTORY, MAX_VOLTAGE_V, SUBSTEPS};

/// Length of a substep, s.
pub(super) const STEP_S: f32 = (CONTROL_PERIOD_S / SUBSTEPS as f64) as f32;

/// The commands that are on their way to the motors of a block; each lane has its own delay.
///
/// With a delay of `n` whole periods and `f` seconds, command `k - n - 1` acts at the motor for the
/// first `f` seconds of period `k`, and command `k - n` for the rest. A period is integrated in
/// `SUBSTEPS + 1` pieces: the instant `f` cuts one substep in two. The delay is therefore exact,
/// and no piece is longer than a substep. If `f` is 0, the first piece is empty and the others are
/// the substeps.
#[derive(Clone, Copy, Debug)]
pub(super) struct DelayLine {
    /// Last commands after clipping, V, newest first.
    sent_v: [Lanes; MAX_HISTORY],
    /// Number of whole periods of the delay, n.
    whole_periods: Lanes,
    /// Instant in the period at which the voltage changes, f, s.
    change_s: Lanes,
    /// Voltage at the motor until `change_s` in the current period, V; if `change_s` is 0, the
    /// voltage at the end of the period before, or with the longest delay the same as `after_v`.
    before_v: Lanes,
    /// Voltage at the motor after `change_s`, V.
    after_v: Lanes,
    /// Largest voltage, V.
    largest_v: f32,
}

impl DelayLine {
    /// A delay line without delay that has sent nothing.
    pub(super) const EMPTY: Self = Self {
        sent_v: [[0.0; BLOCK]; MAX_HISTORY],
        whole_periods: [0.0; BLOCK],
        change_s: [0.0; BLOCK],
        before_v: [0.0; BLOCK],
        after_v: [0.0; BLOCK],
        largest_v: MAX_VOLTAGE_V as f32,
    };

    /// An empty line that clips to this largest voltage, V.
    pub(super) fn limited_to(largest_v: f32) -> Self {
        Self { largest_v, ..Self::EMPTY }
    }

    /// Largest voltage, V. Loops over lanes copy it to a local variable first, because a load
    /// inside the loop would keep the loop from becoming vector code.
    #[inline(always)]
    pub(super) fn largest_v(&self) -> f32 {
        self.largest_v
    }

    /// Restarts a lane with no commands in its past and a new delay, s.
    ///
    /// # Panics
    /// Panics if the delay is negative, longer than [`MAX_HISTORY`] periods, or NaN.
    pub(super) fn restart(&mut self, lane: usize, delay_s: f64) {
        let longest_s = MAX_HISTORY as f64 * CONTROL_PERIOD_S;
        assert!(
            (0.0..=longest_s).contains(&delay_s),
            "a command delay of {delay_s} s cannot be simulated: give 0 to {longest_s} s"
        );
        for sent_v in &mut self.sent_v {
            sent_v[lane] = 0.0;
        }
        let whole = (delay_s / CONTROL_PERIOD_S).floor();
        self.whole_periods[lane] = whole as f32;
        self.change_s[lane] = (delay_s - whole * CONTROL_PERIOD_S).max(0.0) as f32;
    }

    /// Replaces the past commands of all lanes, V, newest first.
    #[inline(always)]
    pub(super) fn resume(&mut self, sent_v: &[Lanes; MAX_HISTORY]) {
        self.sent_v = *sent_v;
    }

    /// Returns whether a lane's commands act without delay.
    pub(super) fn is_immediate(&self, lane: usize) -> bool {
        self.whole_periods[lane] == 0.0 && self.change_s[lane] == 0.0
    }

    /// The last commands of all lanes, V, newest first.
    #[inline(always)]
    pub(super) fn all_sent_v(&self) -> &[Lanes; MAX_HISTORY] {
        &self.sent_v
    }

    /// Begins a period with these commands.
    #[inline(always)]
    pub(super) fn begin_period(&mut self, commands_v: &Lanes) {
        let largest_v = self.largest_v;
        for lane in 0..BLOCK {
            let mut newer_v = limited_to(commands_v[lane], largest_v);
            let (mut before_v, mut after_v) = (newer_v, newer_v);
            for (age, sent_v) in self.sent_v.iter().enumerate() {
                let older_v = sent_v[lane];
                let arrives = self.whole_periods[lane] == age as f32;
                before_v = if arrives { older_v } else { before_v };
                after_v = if arrives { newer_v } else { after_v };
                newer_v = older_v;
            }
            // With the longest delay, a whole number of periods, the voltage does not change within
            // the period. The line does not store the command that acted in the period before, so
            // `before_v` is the voltage of this period too.
            let oldest = self.whole_periods[lane] == MAX_HISTORY as f32;
            self.before_v[lane] = if oldest { newer_v } else { before_v };
            self.after_v[lane] = if oldest { newer_v } else { after_v };
        }
    }

    /// The voltages at the motors just before the current period begins, V. In a lane with the
    /// longest delay it is the voltage of the current period.
    #[inline(always)]
    pub(super) fn before_v(&self) -> &Lanes {
        &self.before_v
    }

    /// Length of one piece of the period, s, and voltage at the motor, V, for every lane.
    #[inline(always)]
    pub(super) fn pieces(&self, piece: usize) -> (Lanes, Lanes) {
        let (mut steps_s, mut voltages_v) = ([0.0; BLOCK], [0.0; BLOCK]);
        for lane in 0..BLOCK {
            (steps_s[lane], voltages_v[lane]) = self.piece(piece, lane);
        }
        (steps_s, voltages_v)
    }

    #[inline(always)]
    fn piece(&self, piece: usize, lane: usize) -> (f32, f32) {
        let change_s = self.change_s[lane];
        // The part of a substep that lies before the change of the voltage, s.
        let unchanged_s = |substep: usize| (change_s - substep as f32 * STEP_S).clamp(0.0, STEP_S);
        let rest_s = if piece == 0 { 0.0 } else { STEP_S - unchanged_s(piece - 1) };
        let begun_s = if piece == SUBSTEPS { 0.0 } else { unchanged_s(piece) };
        let changed = change_s <= piece as f32 * STEP_S;
        (rest_s + begun_s, if changed { self.after_v[lane] } else { self.before_v[lane] })
    }

    /// Ends the period: adds its commands to the past ones.
    #[inline(always)]
    pub(super) fn end_period(&mut self, commands_v: &Lanes) {
        self.sent_v.rotate_right(1);
        let largest_v = self.largest_v;
        for lane in 0..BLOCK {
            self.sent_v[0][lane] = limited_to(commands_v[lane], largest_v);
        }
    }
}

/// Clips a voltage to +-`largest_v`, V; NaN stays NaN. Unlike `clamp` it has no check of its
/// limits, which would keep loops over lanes from becoming vector code.
#[must_use]
#[inline(always)]
pub fn limited_to<T: Scalar>(voltage_v: T, largest_v: T) -> T {
    let voltage_v = if voltage_v < -largest_v { -largest_v } else { voltage_v };
    if voltage_v > largest_v { largest_v } else { voltage_v }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The non-empty pieces of lane 0 in a period, as (duration, voltage).
    fn pieces(line: &DelayLine) -> Vec<(f32, f32)> {
        let all = (0..=SUBSTEPS).map(|piece| line.piece(piece, 0));
        all.filter(|(duration_s, _)| *duration_s > 1e-7).collect()
    }

    #[test]
    fn a_command_is_at_the_motor_for_one_period_after_its_delay() {
        for delay_us in (0..=40_000).step_by(250) {
            let delay_s = f64::from(delay_us) * 1e-6;
            let mut line = DelayLine::EMPTY;
            line.restart(0, delay_s);
            let mut time_s = 0.0;
            for period in 0..20 {
                // Command k is k + 1 tenths of a volt; before the first there is none.
                let command_v = 0.1 * (period + 1) as f32;
                line.begin_period(&[command_v; BLOCK]);
                for (duration_s, voltage_v) in pieces(&line) {
                    let middle_s = time_s + 0.5 * f64::from(duration_s);
                    let sent = ((middle_s - delay_s) / CONTROL_PERIOD_S).floor() + 1.0;
                    let expected_v = 0.1 * sent.max(0.0);
                    assert!((f64::from(voltage_v) - expected_v).abs() < 1e-5, "{delay_us} us");
                    assert!(duration_s <= STEP_S * 1.000_001);
                    time_s += f64::from(duration_s);
                }
                line.end_period(&[command_v; BLOCK]);
                assert!((time_s - 0.01 * f64::from(period + 1)).abs() < 1e-6, "{delay_us} us");
            }
        }
    }

    #[test]
    fn a_delay_that_the_line_does_not_span_is_refused() {
        for delay_s in [-0.01, 0.040_001, 0.045, 0.05, 0.1, f64::NAN] {
            let restarted = std::panic::catch_unwind(|| {
                let mut line = DelayLine::EMPTY;
                line.restart(0, delay_s);
            });
            assert!(restarted.is_err(), "{delay_s} s");
        }
    }

    #[test]
    fn without_a_delay_the_pieces_are_the_substeps_to_the_last_bit() {
        let mut line = DelayLine::EMPTY;
        line.restart(0, 0.0);
        line.begin_period(&[7.0; BLOCK]);
        assert!(line.is_immediate(0));
        assert_eq!(line.piece(0, 0).0, 0.0);
        for piece in 1..=SUBSTEPS {
            assert_eq!(line.piece(piece, 0), (STEP_S, 5.0));
        }
    }
}
