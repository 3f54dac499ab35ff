use std::fmt;
use std::str::FromStr;

use thiserror::Error;

use crate::clock::Nanoseconds;

/// Interval of the timer by which the 16U2 of a genuine Uno or Mega passes received bytes to USB,
/// ns: timer 0 overflows after 256 x 256 clocks of 16 MHz (public source of its firmware).
const FLUSH_NS: Nanoseconds = 4_096_000;

/// Length of a frame of full-speed USB, ns; bytes in either direction wait for the next frame.
const FRAME_NS: Nanoseconds = 1_000_000;

/// Time from the end of a frame until the computer's driver delivers its bytes, ns.
const HAND_OVER_NS: Nanoseconds = 300_000;

/// Phases of timer and frame in the host's clock, ns. On a real bridge they are unknown, so the
/// values are arbitrary.
const FLUSH_PHASE_NS: Nanoseconds = 1_234_000;
const FRAME_PHASE_NS: Nanoseconds = 567_000;

/// The USB bridge between the board's serial line and the computer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UsbBridge {
    /// The second microcontroller of a genuine Uno or Mega.
    Atmega16u2,
    /// A bridge that passes bytes to the computer every 20 ms, too slowly for control.
    Slow,
}

impl UsbBridge {
    fn flush_ns(self) -> Nanoseconds {
        match self {
            Self::Atmega16u2 => FLUSH_NS,
            Self::Slow => 20_000_000,
        }
    }

    /// Time, ns, at which the computer receives a byte that the bridge got from the board at
    /// `arrival_ns`.
    #[must_use]
    pub fn reaches_host_ns(self, arrival_ns: Nanoseconds) -> Nanoseconds {
        let flushed_ns = next(arrival_ns, self.flush_ns(), FLUSH_PHASE_NS);
        next(flushed_ns, FRAME_NS, FRAME_PHASE_NS) + HAND_OVER_NS
    }

    /// Time, ns, at which the bridge begins to pass on bytes that the computer wrote at
    /// `written_ns`.
    #[must_use]
    pub fn leaves_bridge_ns(self, written_ns: Nanoseconds) -> Nanoseconds {
        next(written_ns, FRAME_NS, FRAME_PHASE_NS)
    }
}

/// The first expiry of a periodic timer at or after a time.
fn next(time_ns: Nanoseconds, interval_ns: Nanoseconds, phase_ns: Nanoseconds) -> Nanoseconds {
    let offset_ns = phase_ns % interval_ns;
    (time_ns + interval_ns - offset_ns).div_ceil(interval_ns) * interval_ns + offset_ns
        - interval_ns
}

impl fmt::Display for UsbBridge {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Atmega16u2 => "16u2",
            Self::Slow => "slow",
        })
    }
}

/// The error for a text that names no bridge.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("unknown bridge {text}: give 16u2 or slow")]
pub struct UnknownBridge {
    /// Text given.
    pub text: String,
}

impl FromStr for UsbBridge {
    type Err = UnknownBridge;

    fn from_str(text: &str) -> Result<Self, UnknownBridge> {
        [Self::Atmega16u2, Self::Slow]
            .into_iter()
            .find(|bridge| bridge.to_string() == text)
            .ok_or_else(|| UnknownBridge { text: text.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_wait_for_the_timer_and_the_frame_and_never_go_back() {
        let bridge = UsbBridge::Atmega16u2;
        let mut last_ns = 0;
        let (mut longest_ns, mut shortest_ns) = (0, Nanoseconds::MAX);
        for step in 0..100_000_u64 {
            let arrival_ns = step * 7_919;
            let at_host_ns = bridge.reaches_host_ns(arrival_ns);
            assert!(at_host_ns >= arrival_ns && at_host_ns >= last_ns);
            last_ns = at_host_ns;
            longest_ns = longest_ns.max(at_host_ns - arrival_ns);
            shortest_ns = shortest_ns.min(at_host_ns - arrival_ns);
            let left_ns = bridge.leaves_bridge_ns(arrival_ns) - arrival_ns;
            assert!(left_ns < FRAME_NS);
        }
        let waited_ns = longest_ns - HAND_OVER_NS;
        assert!(waited_ns > FLUSH_NS && waited_ns < FLUSH_NS + FRAME_NS, "{longest_ns}");
        assert!(shortest_ns < FRAME_NS, "{shortest_ns}");
    }

    #[test]
    fn a_bridge_is_read_as_it_is_written() {
        for bridge in [UsbBridge::Atmega16u2, UsbBridge::Slow] {
            assert_eq!(bridge.to_string().parse(), Ok(bridge));
        }
        assert!("ftdi".parse::<UsbBridge>().is_err());
    }
}
