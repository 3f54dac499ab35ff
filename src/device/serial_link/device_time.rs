/// Widens the device's 32-bit clock to 64 bits, us. The differences of times are right while
/// consecutive samples are less than 71 minutes apart.
#[derive(Clone, Copy, Debug, Default)]
pub struct DeviceTime {
    time_us: Option<u64>,
}

impl DeviceTime {
    /// The time of a sample, us, from the device's 32-bit clock. The first sample has the clock's
    /// own value.
    pub fn unwrap_us(&mut self, raw_us: u32) -> u64 {
        let time_us = match self.time_us {
            None => u64::from(raw_us),
            Some(last_us) => last_us + u64::from(raw_us.wrapping_sub(last_us as u32)),
        };
        self.time_us = Some(time_us);
        time_us
    }
}
