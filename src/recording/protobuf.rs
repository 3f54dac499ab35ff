//! Writes Protocol Buffers messages (proto3), which a few of a recording's channels use.

use crate::storage::ProtobufMessage;

/// A message that grows field by field. A field with its default value is left out, as proto3
/// requires.
#[derive(Debug, Default)]
pub(super) struct Message(ProtobufMessage);

impl Message {
    /// The bytes of the message.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.0.into_bytes()
    }

    pub(super) fn double(self, field: u64, value: f64) -> Self {
        // Minus zero is not the default 0: its bits are kept.
        if value.to_bits() == 0 { self } else { Self(self.0.double(field, value)) }
    }

    /// Adds an integer that is not negative.
    pub(super) fn integer(self, field: u64, value: u64) -> Self {
        if value == 0 { self } else { Self(self.0.integer(field, value)) }
    }

    pub(super) fn flag(self, field: u64, value: bool) -> Self {
        self.integer(field, u64::from(value))
    }

    pub(super) fn text(self, field: u64, value: &str) -> Self {
        if value.is_empty() { self } else { Self(self.0.text(field, value)) }
    }

    /// Adds a message within this one; an empty one is written too.
    pub(super) fn message(self, field: u64, inner: &Self) -> Self {
        Self(self.0.message(field, &inner.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_left_out_but_empty_messages_are_not() {
        let defaults = Message::default().double(1, 0.0).integer(2, 0).text(3, "").flag(4, false);
        assert!(defaults.into_bytes().is_empty());
        assert_eq!(Message::default().double(1, -0.0).into_bytes().len(), 9);
        assert_eq!(Message::default().flag(4, true).into_bytes(), [0x20, 1]);
        assert_eq!(Message::default().message(1, &Message::default()).into_bytes(), [0x0a, 0]);
    }
}
