use std::fmt::Write as _;

/// The numbers of one message that JSON cannot represent (NaN of any kind, infinities), kept by
/// name and bits in one text beside the message's fields: `wanted_v=7ff8000000000000 ...`.
///
/// Such numbers appear in the tick in which something fails, so they must not be lost. A string in
/// the field itself would violate the schema, which requires a `number`; `null` alone would not
/// distinguish NaN from an infinity.
#[derive(Debug, Default)]
pub(super) struct NotFinite {
    text: String,
}

impl NotFinite {
    /// Returns the value if JSON can represent it; otherwise stores its bits and returns `None`.
    pub(super) fn keep(&mut self, name: &str, value: f64) -> Option<f64> {
        if value.is_finite() {
            return Some(value);
        }
        self.keep_bits(name, value.to_bits());
        None
    }

    /// Stores the bits of a number of another type, such as `f32`, under its name.
    pub(super) fn keep_bits(&mut self, name: &str, bits: u64) {
        let separator = if self.text.is_empty() { "" } else { " " };
        // Writing to a String cannot fail.
        let _ = write!(self.text, "{separator}{name}={bits:016x}");
    }

    /// The text for the message; `None` if every number was finite.
    pub(super) fn into_text(self) -> Option<String> {
        (!self.text.is_empty()).then_some(self.text)
    }
}

/// Restores a number from its field and the text of [`NotFinite`]; `None` if neither holds it.
pub(super) fn restore(name: &str, finite: Option<f64>, not_finite: Option<&str>) -> Option<f64> {
    finite.or_else(|| restore_bits(name, not_finite).map(f64::from_bits))
}

/// Restores the bits that [`NotFinite::keep_bits`] stored.
pub(super) fn restore_bits(name: &str, not_finite: Option<&str>) -> Option<u64> {
    not_finite?.split(' ').find_map(|entry| {
        let bits = entry.strip_prefix(name)?.strip_prefix('=')?;
        u64::from_str_radix(bits, 16).ok()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_comes_back_with_its_bits() {
        let values =
            [1.5, f64::NAN, -f64::NAN, f64::INFINITY, f64::from_bits(0x7ff0_dead_beef_0001)];
        let names = ["a", "ab", "b", "c", "d"];
        let mut not_finite = NotFinite::default();
        let kept: Vec<_> = names.iter().zip(values).map(|(n, v)| not_finite.keep(n, v)).collect();
        let text = not_finite.into_text();
        for ((name, value), kept) in names.iter().zip(values).zip(kept) {
            let restored = restore(name, kept, text.as_deref()).map(f64::to_bits);
            assert_eq!(restored, Some(value.to_bits()), "{name}");
        }
        assert_eq!(restore("e", None, text.as_deref()), None);
        assert_eq!(NotFinite::default().into_text(), None);
    }
}
