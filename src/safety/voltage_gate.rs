use crate::qube::MAX_VOLTAGE_V;

/// A controller asked for a voltage that is not a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotANumber;

/// The last gate before the wire: a wanted voltage in V to millivolts within the limit.
///
/// # Errors
/// [`NotANumber`] for NaN and infinities: no voltage can be meant by them.
pub fn gate(voltage_v: f64) -> Result<i16, NotANumber> {
    if !voltage_v.is_finite() {
        return Err(NotANumber);
    }
    let limited_v = voltage_v.clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V);
    Ok((limited_v * 1000.0).round() as i16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gate_limits_and_refuses() {
        assert_eq!(gate(1.2344), Ok(1234));
        assert_eq!(gate(-7.0), Ok(-5000));
        assert_eq!(gate(f64::MAX), Ok(5000));
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(gate(bad), Err(NotANumber));
        }
    }
}
