use crate::telemetry::TickRecord;

/// Number of ticks kept before a fault: one second.
pub const LAST_TICKS: usize = 100;

/// Ring of the last ticks of a motion. Adding a tick does not allocate.
#[derive(Debug)]
pub struct LastTicks {
    ring: Vec<TickRecord>,
    next: usize,
}

impl LastTicks {
    /// An empty ring.
    pub fn new() -> Self {
        Self { ring: Vec::with_capacity(LAST_TICKS), next: 0 }
    }

    /// Adds one tick and drops the oldest if the ring is full.
    pub fn push(&mut self, tick: &TickRecord) {
        match self.ring.get_mut(self.next) {
            Some(oldest) => *oldest = *tick,
            None => self.ring.push(*tick),
        }
        self.next = (self.next + 1) % LAST_TICKS;
    }

    /// All ticks, oldest first.
    pub fn into_ticks(mut self) -> Vec<TickRecord> {
        if self.ring.len() == LAST_TICKS {
            self.ring.rotate_left(self.next);
        }
        self.ring
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_hundred_come_out_in_order() {
        for count in [0_u32, 1, 99, 100, 101, 250] {
            let mut last = LastTicks::new();
            for tick in 0..count {
                last.push(&TickRecord { tick, ..TickRecord::default() });
            }
            assert_eq!(last.ring.capacity(), LAST_TICKS);
            let ticks: Vec<u32> = last.into_ticks().iter().map(|record| record.tick).collect();
            assert_eq!(ticks, (count.saturating_sub(100)..count).collect::<Vec<_>>());
        }
    }
}
