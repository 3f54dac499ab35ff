//! Reads the wire format of Protocol Buffers: a message is a series of numbered fields, and a
//! reader skips those that it does not know.

/// The value of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// An integer of variable length, or an enum or bool.
    Varint(u64),
    /// Eight bytes, little-endian.
    Fixed64([u8; 8]),
    /// A string, a message, or packed numbers.
    Bytes(&'a [u8]),
    /// Four bytes, little-endian.
    Fixed32([u8; 4]),
}

/// The error that bytes are not a message, or not a field of the expected type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Malformed;

/// The fields of a message in order. The iterator ends after the first error.
#[derive(Clone, Debug)]
pub struct Fields<'a> {
    rest: &'a [u8],
}

impl<'a> Fields<'a> {
    /// The fields of these bytes.
    pub fn of(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    fn field(&mut self) -> Result<(u64, Value<'a>), Malformed> {
        let tag = self.varint()?;
        let value = match tag & 7 {
            0 => Value::Varint(self.varint()?),
            1 => Value::Fixed64(self.array()?),
            2 => {
                let length = usize::try_from(self.varint()?).map_err(|_| Malformed)?;
                Value::Bytes(self.bytes(length)?)
            }
            5 => Value::Fixed32(self.array()?),
            _ => return Err(Malformed),
        };
        Ok((tag >> 3, value))
    }

    fn varint(&mut self) -> Result<u64, Malformed> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let [byte] = self.array()?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(Malformed)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        self.bytes(N)?.try_into().map_err(|_| Malformed)
    }

    fn bytes(&mut self, length: usize) -> Result<&'a [u8], Malformed> {
        let (taken, rest) = self.rest.split_at_checked(length).ok_or(Malformed)?;
        self.rest = rest;
        Ok(taken)
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = Result<(u64, Value<'a>), Malformed>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() {
            return None;
        }
        let field = self.field();
        if field.is_err() {
            self.rest = &[];
        }
        Some(field)
    }
}

impl<'a> Value<'a> {
    /// The text of a string field.
    pub fn text(self) -> Result<&'a str, Malformed> {
        std::str::from_utf8(self.bytes()?).map_err(|_| Malformed)
    }

    /// The bytes of a field with a length: a string, a message, or packed numbers.
    pub fn bytes(self) -> Result<&'a [u8], Malformed> {
        match self {
            Self::Bytes(bytes) => Ok(bytes),
            _ => Err(Malformed),
        }
    }

    /// The integer of a field of variable length.
    pub fn integer(self) -> Result<i64, Malformed> {
        match self {
            Self::Varint(value) => Ok(value as i64),
            _ => Err(Malformed),
        }
    }

    /// The integers of a repeated field, packed or not.
    pub fn integers(self) -> Result<Vec<i64>, Malformed> {
        let Self::Bytes(bytes) = self else { return Ok(vec![self.integer()?]) };
        let (mut packed, mut all) = (Fields::of(bytes), Vec::new());
        while !packed.rest.is_empty() {
            all.push(packed.varint()? as i64);
        }
        Ok(all)
    }

    /// The single-precision numbers of a field, packed or not.
    pub fn floats(self) -> Result<Vec<f32>, Malformed> {
        match self {
            Self::Fixed32(bytes) => Ok(vec![f32::from_le_bytes(bytes)]),
            Self::Bytes(bytes) => floats(bytes),
            _ => Err(Malformed),
        }
    }
}

/// The little-endian single-precision numbers in these bytes.
pub fn floats(bytes: &[u8]) -> Result<Vec<f32>, Malformed> {
    let (numbers, []) = bytes.as_chunks() else { return Err(Malformed) };
    Ok(numbers.iter().map(|number| f32::from_le_bytes(*number)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::storage::ProtobufMessage;

    #[test]
    fn fields_are_read_in_order() {
        let bytes = [0x08, 0x96, 0x01, 0x12, 0x02, b'h', b'i', 0x1d, 0, 0, 0x80, 0x3f];
        let fields: Vec<_> = Fields::of(&bytes).map(Result::unwrap).collect();
        assert_eq!(fields[0], (1, Value::Varint(150)));
        assert_eq!((fields[1].0, fields[1].1.text()), (2, Ok("hi")));
        assert_eq!((fields[2].0, fields[2].1.floats()), (3, Ok(vec![1.0])));
        assert_eq!(Value::Bytes(&[1, 0x96, 1]).integers(), Ok(vec![1, 150]));
    }

    #[test]
    fn fields_are_read_as_they_were_written() {
        let inner = ProtobufMessage::default().text(2, "hi");
        let message = ProtobufMessage::default().integer(1, 150).number(3, 1.5).message(20, &inner);
        let bytes = message.into_bytes();
        let fields: Vec<_> = Fields::of(&bytes).map(Result::unwrap).collect();
        assert_eq!(fields[0], (1, Value::Varint(150)));
        assert_eq!(fields[1], (3, Value::Fixed32(1.5_f32.to_le_bytes())));
        let (20, Value::Bytes(inner)) = fields[2] else { panic!("{fields:?}") };
        assert_eq!(Fields::of(inner).next(), Some(Ok((2, Value::Bytes(b"hi")))));
        let large = ProtobufMessage::default().integer(1, u64::MAX).into_bytes();
        assert_eq!(Fields::of(&large).next(), Some(Ok((1, Value::Varint(u64::MAX)))));
    }

    #[test]
    fn bytes_that_are_no_message_end_with_an_error() {
        for bytes in [&[0x08][..], &[0x12, 9, 1], &[0x0b], &[0xff; 11], &[0x1d, 0]] {
            assert_eq!(Fields::of(bytes).last(), Some(Err(Malformed)), "{bytes:?}");
        }
    }
}
