/// Number of commands remembered: they span the longest delay together with the longest silence of
/// a link before the rollout ends.
const REMEMBERED: usize = 16;

/// The voltages that were sent and the instants from which each acts.
///
/// The type is generic over the voltage. A simulation with a fixed period stores the numbers of
/// commands in place of voltages, and thus computes only once which command acts when.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SentVoltages<V = f64> {
    delay_us: u64,
    /// Commands, oldest first. The oldest also counts for all times before its own instant.
    commands: [Command<V>; REMEMBERED],
    count: usize,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Command<V> {
    acts_from_us: u64,
    voltage: V,
}

/// A voltage and the time for which it acts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece<V = f64> {
    /// Voltage, V, or the number of a command in its place.
    pub voltage: V,
    /// Duration, us.
    pub duration_us: u64,
}

impl<V: Copy> SentVoltages<V> {
    /// A history in which only `voltage` was ever sent; a command acts `delay_s` after the instant
    /// of its sample.
    #[must_use]
    pub fn new(delay_s: f64, voltage: V) -> Self {
        Self {
            delay_us: (delay_s * 1e6).round() as u64,
            commands: [Command { acts_from_us: 0, voltage }; REMEMBERED],
            count: 1,
        }
    }

    /// Delay from the instant of a sample until the command computed from it acts, us.
    #[must_use]
    pub fn delay_us(&self) -> u64 {
        self.delay_us
    }

    /// Records the voltage that was sent in answer to the sample of this instant; instants must not
    /// decrease.
    pub fn send(&mut self, sample_us: u64, voltage: V) {
        if self.count == REMEMBERED {
            self.commands.rotate_left(1);
            self.count -= 1;
        }
        let acts_from_us = sample_us.saturating_add(self.delay_us);
        self.commands[self.count] = Command { acts_from_us, voltage };
        self.count += 1;
    }

    /// The voltages that act between two instants, in order.
    pub fn between(&self, from_us: u64, until_us: u64) -> impl Iterator<Item = Piece<V>> {
        (0..self.count).filter_map(move |index| {
            let Command { acts_from_us, voltage } = self.commands[index];
            let begins_us = if index == 0 { 0 } else { acts_from_us };
            let next = self.commands[..self.count].get(index + 1);
            let ends_us = next.map_or(u64::MAX, |next| next.acts_from_us);
            let duration_us = ends_us.min(until_us).saturating_sub(begins_us.max(from_us));
            (duration_us > 0).then_some(Piece { voltage, duration_us })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pieces(sent: &SentVoltages, from_us: u64, until_us: u64) -> Vec<(f64, u64)> {
        sent.between(from_us, until_us).map(|piece| (piece.voltage, piece.duration_us)).collect()
    }

    #[test]
    fn each_voltage_acts_after_its_delay_until_the_next_voltage_acts() {
        let mut sent = SentVoltages::new(0.013, 0.0);
        assert_eq!(pieces(&sent, 0, 10_000), [(0.0, 10_000)]);
        sent.send(0, 1.0);
        sent.send(10_000, 2.0);
        // One sample is lost; the previous voltage is held.
        sent.send(30_000, 3.0);
        assert_eq!(pieces(&sent, 0, 10_000), [(0.0, 10_000)]);
        assert_eq!(pieces(&sent, 10_000, 30_000), [(0.0, 3_000), (1.0, 10_000), (2.0, 7_000)]);
        assert_eq!(pieces(&sent, 30_000, 60_000), [(2.0, 13_000), (3.0, 17_000)]);
        assert_eq!(pieces(&sent, 60_000, 60_000), []);
    }

    #[test]
    fn without_a_delay_a_voltage_acts_at_once() {
        let mut sent = SentVoltages::new(0.0, 0.0);
        sent.send(0, 1.0);
        sent.send(10_000, 2.0);
        assert_eq!(pieces(&sent, 0, 20_000), [(1.0, 10_000), (2.0, 10_000)]);
    }

    #[test]
    fn the_history_covers_the_longest_delay_and_a_silence() {
        let mut sent = SentVoltages::new(0.1, 0.0);
        for step in 0..100_u64 {
            sent.send(step * 10_000, step as f64);
        }
        let expected: Vec<(f64, u64)> = (86..=99).map(|step| (f64::from(step), 10_000)).collect();
        assert_eq!(pieces(&sent, 960_000, 1_100_000), expected);
    }
}
