/// Rate of the line, bits per second, 8N1: exact on a 16 MHz microcontroller, where 115 200 is 2 %
/// off.
pub const BAUD_RATE: u32 = 500_000;

/// Bits for each byte: start bit, eight data bits, stop bit.
pub const BITS_PER_BYTE: u32 = 10;

/// Time without an arm or an accepted act after which the device switches its amplifier off, ms.
pub const WATCHDOG_MS: u16 = 50;

/// Longest interval between two checks of the watchdog, ms: the amplifier is off at most this much
/// later than [`WATCHDOG_MS`].
pub const WATCHDOG_POLL_MS: u16 = 5;

/// Largest age of the sample that an act names, by the device's clock, microseconds. It is two
/// control periods: the sample of one tick never serves the tick after the next.
pub const MAX_SAMPLE_AGE_US: u32 = 20_000;

/// Value of `sample_to_act_us` if no act followed the previous sample.
pub const NO_ACT_US: u16 = 0xFFFF;
