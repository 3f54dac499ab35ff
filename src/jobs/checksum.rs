use crc::{CRC_64_XZ, Crc};

const CRC: Crc<u64> = Crc::<u64>::new(&CRC_64_XZ);

/// The CRC-64/XZ of these bytes, as 16 hexadecimal digits.
pub(super) fn checksum(bytes: &[u8]) -> String {
    format!("{:016x}", CRC.checksum(bytes))
}
