use crate::qube::MAX_VOLTAGE_V;

/// The error of a controller that requested a voltage that is NaN or infinite.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotFinite;

/// Converts a requested voltage, V, to millivolts and limits it to the largest voltages of plant
/// and wire: the last step before the wire. A largest voltage that is not above 0 V gives 0 mV.
///
/// # Errors
/// [`NotFinite`] for NaN and infinities.
pub fn clamp_to_mv(voltage_v: f64, largest_v: f64) -> Result<i16, NotFinite> {
    if !voltage_v.is_finite() {
        return Err(NotFinite);
    }
    // The comparison is false for NaN too.
    let largest_v = if largest_v > 0.0 { largest_v.min(MAX_VOLTAGE_V) } else { 0.0 };
    let limited_v = voltage_v.clamp(-largest_v, largest_v);
    Ok((limited_v * 1000.0).round() as i16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clamp_limits_and_refuses() {
        assert_eq!(clamp_to_mv(1.2344, 5.0), Ok(1234));
        assert_eq!(clamp_to_mv(-7.0, 5.0), Ok(-5000));
        assert_eq!(clamp_to_mv(f64::MAX, 5.0), Ok(5000));
        assert_eq!(clamp_to_mv(-7.0, 3.5), Ok(-3500));
        for largest_v in [7.0, f64::INFINITY] {
            assert_eq!(clamp_to_mv(9.0, largest_v), Ok(5000));
        }
        for largest_v in [0.0, -5.0, f64::NEG_INFINITY, f64::NAN] {
            assert_eq!(clamp_to_mv(9.0, largest_v), Ok(0));
        }
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(clamp_to_mv(bad, 5.0), Err(NotFinite));
        }
    }

    /// Compares the limited voltage with the wanted one, an `f32` with these bits.
    fn check(bits: u32) {
        let wanted_v = f32::from_bits(bits);
        match clamp_to_mv(f64::from(wanted_v), 5.0) {
            Ok(millivolts) => {
                assert!(wanted_v.is_finite() && (-5000..=5000).contains(&millivolts), "{bits:#x}");
                let limited_v = wanted_v.clamp(-5.0, 5.0);
                assert!((f32::from(millivolts) - 1000.0 * limited_v).abs() <= 0.501, "{bits:#x}");
            }
            Err(NotFinite) => assert!(!wanted_v.is_finite(), "{bits:#x}"),
        }
    }

    #[test]
    fn a_sample_of_all_patterns_of_an_f32_is_clamped_or_refused() {
        // The stride is odd, so that the samples spread over all exponents and both signs.
        (0..200_000_u32).for_each(|number| check(number.wrapping_mul(21_467)));
        for edge in [0.0, -0.0, 5.0, -5.0, f32::MIN_POSITIVE, f32::MAX, f32::NAN, f32::INFINITY] {
            let bits = edge.to_bits();
            [bits.wrapping_sub(1), bits, bits + 1].into_iter().for_each(check);
        }
    }

    #[test]
    #[ignore = "all 2^32 patterns, half a minute: scripts/adversary runs it"]
    fn every_pattern_of_an_f32_is_clamped_or_refused() {
        (0..=u32::MAX).for_each(check);
    }
}
