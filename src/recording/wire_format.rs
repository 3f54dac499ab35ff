use std::collections::BTreeMap;

use crc::{CRC_32_ISO_HDLC, Crc, Table};

/// The checksum that MCAP uses.
pub(super) const CRC_32: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISO_HDLC);

/// First and last bytes of every MCAP file.
pub(super) const MAGIC: &[u8] = mcap::MAGIC;

/// Number of bytes before the body of a record: an opcode of one byte and a length of eight.
pub(super) const FRAME_BYTES: usize = 9;

/// Opcodes of the records in a recording (MCAP specification, "Records").
pub(super) mod opcode {
    pub(crate) use mcap::records::op::{
        ATTACHMENT, CHANNEL, CHUNK, DATA_END, FOOTER, HEADER, MESSAGE, MESSAGE_INDEX, METADATA,
        SCHEMA,
    };
}

/// One record of an MCAP file; `offset` is the position of its opcode in the file.
#[derive(Clone, Copy)]
pub(super) struct Frame<'a> {
    pub(super) offset: usize,
    pub(super) opcode: u8,
    pub(super) body: &'a [u8],
}

impl Frame<'_> {
    /// The offset after the record.
    pub(super) fn end(&self) -> usize {
        self.offset + FRAME_BYTES + self.body.len()
    }
}

/// The record at `offset`; `None` if the bytes end within it.
pub(super) fn frame(bytes: &[u8], offset: usize) -> Option<Frame<'_>> {
    let (&opcode, rest) = bytes.get(offset..)?.split_first()?;
    let (length, rest) = rest.split_first_chunk()?;
    let length = usize::try_from(u64::from_le_bytes(*length)).ok()?;
    Some(Frame { offset, opcode, body: rest.get(..length)? })
}

/// A reader of the fields of a record, one after the other. A method returns `None` if the bytes
/// end before the field does, or if a text is not UTF-8.
///
/// This reader accepts files of any origin. The readers of the `mcap` crate trust some lengths:
/// they allocate or index by a length that a hostile file chooses.
pub(super) struct Fields<'a>(pub(super) &'a [u8]);

impl<'a> Fields<'a> {
    pub(super) fn bytes(&mut self, length: usize) -> Option<&'a [u8]> {
        let (head, tail) = self.0.split_at_checked(length)?;
        self.0 = tail;
        Some(head)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.bytes(N)?.try_into().ok()
    }

    pub(super) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub(super) fn text(&mut self) -> Option<&'a str> {
        let length = usize::try_from(self.u32()?).ok()?;
        std::str::from_utf8(self.bytes(length)?).ok()
    }

    pub(super) fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let length = usize::try_from(self.u32()?).ok()?;
        let mut entries = Fields(self.bytes(length)?);
        let mut map = BTreeMap::new();
        while !entries.0.is_empty() {
            map.insert(entries.text()?.to_owned(), entries.text()?.to_owned());
        }
        Some(map)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_has_the_published_check_value() {
        assert_eq!(CRC_32.checksum(b"123456789"), 0xcbf4_3926);
    }

    #[test]
    fn lengths_beyond_the_end_are_no_record_and_no_field() {
        let mut bytes = vec![7; 9];
        bytes[1..9].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(frame(&bytes, 0).is_none());
        bytes[1..9].copy_from_slice(&1_u64.to_le_bytes());
        assert!(frame(&bytes, 0).is_none());
        bytes.push(3);
        assert_eq!(frame(&bytes, 0).map(|frame| (frame.opcode, frame.end())), Some((7, 10)));
        assert!(frame(&bytes, 11).is_none());
        assert!(Fields(&[255, 255, 255, 255, 1]).text().is_none());
        assert!(Fields(&[5, 0, 0, 0, 1, 0, 0, 0, 65]).map().is_none());
    }
}
