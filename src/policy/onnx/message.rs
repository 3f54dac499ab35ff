//! A writer of the wire format of Protocol Buffers.
//!
//! Before each value stands a tag: the number of the field, and in the lowest three bits the kind
//! of the value (0 a varint, 2 a length and as many bytes, 5 four bytes).

/// A message that grows field by field.
#[derive(Debug, Default)]
pub struct Message {
    bytes: Vec<u8>,
}

impl Message {
    /// Appends an integer, enum or bool as the field of this number.
    pub fn integer(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    /// Appends a single-precision number.
    pub fn number(mut self, field: u64, value: f32) -> Self {
        self.varint(field << 3 | 5);
        self.bytes.extend(value.to_le_bytes());
        self
    }

    /// Appends bytes.
    pub fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(value.len() as u64);
        self.bytes.extend(value);
        self
    }

    /// Appends a string.
    pub fn text(self, field: u64, value: &str) -> Self {
        self.bytes(field, value.as_bytes())
    }

    /// Appends an embedded message.
    pub fn message(self, field: u64, value: &Self) -> Self {
        self.bytes(field, &value.bytes)
    }

    /// Appends several embedded messages, each as a field of this number.
    pub fn messages<'a>(self, field: u64, values: impl IntoIterator<Item = &'a Self>) -> Self {
        values.into_iter().fold(self, |message, value| message.message(field, value))
    }

    /// The bytes of the message.
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
    use crate::policy::onnx::protobuf::{Fields, Value};

    #[test]
    fn fields_are_read_as_they_were_written() {
        let inner = Message::default().text(2, "hi");
        let message = Message::default().integer(1, 150).number(3, 1.5).message(20, &inner);
        let bytes = message.into_bytes();
        let fields: Vec<_> = Fields::of(&bytes).map(Result::unwrap).collect();
        assert_eq!(fields[0], (1, Value::Varint(150)));
        assert_eq!(fields[1], (3, Value::Fixed32(1.5_f32.to_le_bytes())));
        let (20, Value::Bytes(inner)) = fields[2] else { panic!("{fields:?}") };
        assert_eq!(Fields::of(inner).next(), Some(Ok((2, Value::Bytes(b"hi")))));
        let large = Message::default().integer(1, u64::MAX).into_bytes();
        assert_eq!(Fields::of(&large).next(), Some(Ok((1, Value::Varint(u64::MAX)))));
    }
}
