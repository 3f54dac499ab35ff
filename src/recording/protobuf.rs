//! Writes the wire format of Protocol Buffers, for the few messages of a recording that use it.

/// A message that grows field by field. A field with its default value is left out, as proto3 asks.
#[derive(Debug, Default)]
pub(super) struct Message(Vec<u8>);

/// Wire types of the fields.
const VARINT: u32 = 0;
const FIXED_64: u32 = 1;
const LENGTH: u32 = 2;

impl Message {
    /// The bytes of the message.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    pub(super) fn double(mut self, field: u32, value: f64) -> Self {
        // Minus zero is not the default 0: its bits are kept.
        if value.to_bits() != 0 {
            self.key(field, FIXED_64);
            self.0.extend(value.to_le_bytes());
        }
        self
    }

    /// Adds an integer that is not negative.
    pub(super) fn integer(mut self, field: u32, value: u64) -> Self {
        if value != 0 {
            self.key(field, VARINT);
            self.varint(value);
        }
        self
    }

    pub(super) fn flag(self, field: u32, value: bool) -> Self {
        self.integer(field, u64::from(value))
    }

    pub(super) fn text(mut self, field: u32, value: &str) -> Self {
        if !value.is_empty() {
            self.bytes(field, value.as_bytes());
        }
        self
    }

    /// Adds a message within this one; an empty one is written too.
    pub(super) fn message(mut self, field: u32, inner: &Self) -> Self {
        self.bytes(field, &inner.0);
        self
    }

    fn bytes(&mut self, field: u32, bytes: &[u8]) {
        self.key(field, LENGTH);
        self.varint(bytes.len() as u64);
        self.0.extend(bytes);
    }

    fn key(&mut self, field: u32, wire_type: u32) {
        self.varint(u64::from(field << 3 | wire_type));
    }

    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_those_of_the_specification() {
        // The examples of "Encoding" in the documentation of Protocol Buffers.
        assert_eq!(Message::default().integer(1, 150).into_bytes(), [0x08, 0x96, 0x01]);
        let text = Message::default().text(2, "testing");
        assert_eq!(text.into_bytes(), *b"\x12\x07testing");
        let inner = Message::default().integer(1, 150);
        let outer = Message::default().message(3, &inner);
        assert_eq!(outer.into_bytes(), [0x1a, 0x03, 0x08, 0x96, 0x01]);
        let one = Message::default().double(1, 1.0);
        assert_eq!(one.into_bytes(), [0x09, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f]);
    }

    #[test]
    fn defaults_are_left_out_but_empty_messages_are_not() {
        let defaults = Message::default().double(1, 0.0).integer(2, 0).text(3, "").flag(4, false);
        assert!(defaults.into_bytes().is_empty());
        assert_eq!(Message::default().double(1, -0.0).into_bytes().len(), 9);
        assert_eq!(Message::default().message(1, &Message::default()).into_bytes(), [0x0a, 0]);
    }
}
