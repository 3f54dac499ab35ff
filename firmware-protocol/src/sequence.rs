use crate::MAX_SAMPLE_AGE_US;

/// Returns whether `candidate` comes after `last` on the circle of sequence numbers: 1 to 32 767
/// ahead.
///
/// In C: `(int16_t)(uint16_t)(candidate - last) > 0`.
#[must_use]
pub fn is_newer(candidate: u16, last: u16) -> bool {
    candidate.wrapping_sub(last) as i16 > 0
}

/// Returns whether an act that arrives at `now_us` and names the sample of `sampled_at_us` may be
/// carried out: it must name the last sample that the device gave (`given_us`, `None` if it gave
/// none since the last hello), and that sample must be no older than [`MAX_SAMPLE_AGE_US`]. All
/// times are by the device's clock, microseconds modulo 2^32.
///
/// In C: `given && sampled_at == given_at && (uint32_t)(now - sampled_at) <= MAX_SAMPLE_AGE_US`.
#[must_use]
pub fn answers_fresh_sample(sampled_at_us: u32, given_us: Option<u32>, now_us: u32) -> bool {
    given_us == Some(sampled_at_us) && now_us.wrapping_sub(sampled_at_us) <= MAX_SAMPLE_AGE_US
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn newer_is_half_of_the_circle_ahead() {
        assert!(is_newer(1, 0));
        assert!(is_newer(0x7FFF, 0));
        assert!(is_newer(3, 0xFFF0));
        assert!(!is_newer(5, 5));
        assert!(!is_newer(4, 5));
        assert!(!is_newer(0x8000, 0));
    }
}
