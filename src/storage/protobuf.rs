//! A writer of the wire format of Protocol Buffers.
//!
//! A tag precedes each value: the number of the field, and in the lowest three bits the kind of the
//! value (0 a varint, 1 eight bytes, 2 a length and as many bytes, 5 four bytes).

/// A message that grows field by field. Each field is written, also one with its default value.
#[derive(Clone, Debug, Default)]
pub struct ProtobufMessage {
    bytes: Vec<u8>,
}

impl ProtobufMessage {
    /// Appends an integer, enum or bool as the field of this number.
    #[must_use]
    pub fn integer(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    /// Appends a single-precision number.
    #[must_use]
    pub fn number(mut self, field: u64, value: f32) -> Self {
        self.varint(field << 3 | 5);
        self.bytes.extend(value.to_le_bytes());
        self
    }

    /// Appends a double-precision number.
    #[must_use]
    pub fn double(mut self, field: u64, value: f64) -> Self {
        self.varint(field << 3 | 1);
        self.bytes.extend(value.to_le_bytes());
        self
    }

    /// Appends bytes.
    #[must_use]
    pub fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.bytes.extend(value);
        self
    }

    /// Appends a string.
    #[must_use]
    pub fn text(self, field: u64, value: &str) -> Self {
        self.bytes(field, value.as_bytes())
    }

    /// Appends an embedded message.
    #[must_use]
    pub fn message(self, field: u64, value: &Self) -> Self {
        self.bytes(field, &value.bytes)
    }

    /// Appends several embedded messages, each as a field of this number.
    #[must_use]
    pub fn messages<'a>(self, field: u64, values: impl IntoIterator<Item = &'a Self>) -> Self {
        values.into_iter().fold(self, |message, value| message.message(field, value))
    }

    /// The bytes of the message.
    #[must_use]
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Appends a varint: seven bits a byte, lowest first; bit 7 is set in all bytes but the last.
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.bytes.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.bytes.push(value as u8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_equal_the_examples_of_the_specification() {
        let empty = ProtobufMessage::default;
        // The examples of "Encoding" in the documentation of Protocol Buffers.
        assert_eq!(empty().integer(1, 150).into_bytes(), [0x08, 0x96, 0x01]);
        assert_eq!(empty().text(2, "testing").into_bytes(), *b"\x12\x07testing");
        let outer = empty().message(3, &empty().integer(1, 150));
        assert_eq!(outer.into_bytes(), [0x1a, 0x03, 0x08, 0x96, 0x01]);
        let one = empty().double(1, 1.0);
        assert_eq!(one.into_bytes(), [0x09, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f]);
        assert_eq!(empty().number(1, 1.0).into_bytes(), [0x0d, 0, 0, 0x80, 0x3f]);
        let defaults = empty().integer(1, 0).text(2, "").message(3, &empty());
        assert_eq!(defaults.into_bytes(), [0x08, 0, 0x12, 0, 0x1a, 0]);
    }
}
