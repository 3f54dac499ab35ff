use crc::{CRC_64_XZ, Crc};

const CRC: Crc<u64> = Crc::<u64>::new(&CRC_64_XZ);

/// The CRC-64/XZ of these bytes, as 16 hexadecimal digits. Ledgers, settings and jobs recognise
/// changed or damaged content by it.
#[must_use]
pub fn checksum_of(bytes: &[u8]) -> String {
    format!("{:016x}", CRC.checksum(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The value is the check of the catalogue of CRCs for CRC-64/XZ.
    #[test]
    fn the_checksum_has_the_check_value_of_the_catalogue() {
        assert_eq!(checksum_of(b"123456789"), "995dc9bbdf1939fa");
        assert_eq!(checksum_of(b""), "0000000000000000");
    }
}
