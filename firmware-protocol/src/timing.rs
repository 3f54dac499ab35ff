/// Bits per second, 8N1: exact on a 16 MHz microcontroller, where 115 200 is 2 % off.
pub const BAUD_RATE: u32 = 500_000;

/// Start bit, eight data bits, stop bit.
pub const BITS_PER_BYTE: u32 = 10;

/// Without an arm or an accepted act for this long the device switches its amplifier off, in ms.
pub const WATCHDOG_MS: u16 = 50;

/// A device looks at its watchdog at least this often, in ms: the amplifier is off at most this
/// much later than [`WATCHDOG_MS`].
pub const WATCHDOG_POLL_MS: u16 = 5;

/// An act whose sample is older than this by the device's clock is refused, in microseconds. Two
/// control periods: a sample that the host asked for in one tick never answers for the tick after
/// the next.
pub const MAX_SAMPLE_AGE_US: u32 = 20_000;

/// `sample_to_act_us` when no act followed the previous sample.
pub const NO_ACT_US: u16 = 0xFFFF;
