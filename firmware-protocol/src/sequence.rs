/// Whether `candidate` comes after `last` on the circle of sequence numbers: 1 to 32 767 ahead.
///
/// In C: `(int16_t)(uint16_t)(candidate - last) > 0`.
#[must_use]
pub fn is_newer(candidate: u16, last: u16) -> bool {
    candidate.wrapping_sub(last) as i16 > 0
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
