/// Rate of the line, bits per second, with 8 data bits, no parity and 1 stop bit. A 16 MHz
/// microcontroller meets this rate exactly, whereas it misses 115 200 by 2 %.
pub const BAUD_RATE: u32 = 500_000;

/// Bits on the line for each byte: start bit, eight data bits, stop bit.
pub const BITS_PER_BYTE: u32 = 10;

/// Time since the last accepted `Arm` request or act after which the device switches its amplifier
/// off, ms.
pub const WATCHDOG_MS: u16 = 50;

/// Longest interval between two checks of the watchdog, ms: the device switches its amplifier off
/// at most this much later than [`WATCHDOG_MS`].
pub const WATCHDOG_POLL_MS: u16 = 5;

/// Largest age of the sample that an act names, by the device's clock, microseconds: two control
/// periods, so that a voltage which is sent two ticks after its sample comes too late.
pub const MAX_SAMPLE_AGE_US: u32 = 20_000;

/// Value of `sample_to_act_us` if no act was accepted after the previous sample.
pub const NO_ACT_US: u16 = 0xFFFF;
