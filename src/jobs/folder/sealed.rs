//! Files with a checksum in their first line, so that a half-written or damaged file is recognised.

use thiserror::Error;

use crate::storage::checksum_of;

/// The reason why the bytes of a file are refused: the file is of another kind, half-written or
/// damaged.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("it is not a whole file of the kind `{kind}`: its checksum is wrong")]
pub(super) struct NotSealed {
    kind: &'static str,
}

/// The content of a file of this kind that contains `payload`.
pub(super) fn sealed(kind: &str, payload: &[u8]) -> Vec<u8> {
    let mut bytes = first_line(kind, payload).into_bytes();
    bytes.extend_from_slice(payload);
    bytes
}

/// The payload of a file of this kind.
///
/// # Errors
/// The file is of another kind, half-written or damaged.
pub(super) fn unsealed<'a>(kind: &'static str, bytes: &'a [u8]) -> Result<&'a [u8], NotSealed> {
    let end = bytes.iter().position(|byte| *byte == b'\n').map_or(0, |at| at + 1);
    let (line, payload) = bytes.split_at(end);
    match line == first_line(kind, payload).as_bytes() {
        true => Ok(payload),
        false => Err(NotSealed { kind }),
    }
}

fn first_line(kind: &str, payload: &[u8]) -> String {
    format!("qube-hil {kind} 1 {}\n", checksum_of(payload))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_file_opens_and_any_other_does_not() {
        let whole = sealed("job", b"{\"seed\": 1}\n");
        assert_eq!(unsealed("job", &whole).unwrap(), b"{\"seed\": 1}\n");
        assert!(unsealed("result", &whole).is_err());
        for length in 0..whole.len() {
            assert!(unsealed("job", &whole[..length]).is_err(), "{length}");
        }
        let mut zeros = whole.clone();
        zeros[30..].fill(0);
        assert!(unsealed("job", &zeros).is_err());
    }
}
