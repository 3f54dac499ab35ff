use std::fmt;
use std::str::FromStr;

use thiserror::Error;

/// First word of each address.
const SCHEME: &str = "hil";

/// Card type of an address that names none: the USB panel of a QUBE-Servo 2, which is the most
/// common.
const USUAL_CARD: &str = "qube_servo2_usb";

/// Card identifier of an address that names none: the first card of its type.
const FIRST: &str = "0";

/// Largest lengths, bytes: of a card type, as in the vendor's `hil.h` (`MAX_CARD_TYPE_LENGTH`), and
/// of an identifier, set by this program.
const LONGEST: [usize; 2] = [64, 256];

/// The address of a card of the vendor's library: `hil:CARD@ID`, for example
/// `hil:qube_servo3_usb@0`. `hil:CARD` is the first card of its type, and `hil` alone the first
/// `qube_servo2_usb`. The ID of a virtual card contains a second `@`.
///
/// ```
/// use qube_hil::device::HilAddress;
///
/// let address: HilAddress = "hil:qube_servo3_usb@0@tcpip://localhost:18923".parse()?;
/// assert_eq!((address.card(), address.id()), ("qube_servo3_usb", "0@tcpip://localhost:18923"));
/// # Ok::<(), qube_hil::device::NotAnAddress>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HilAddress {
    card: String,
    id: String,
}

/// The error for a text that is not the address of a card.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "{0:?} names no card: give hil, or hil:CARD@ID with a card type such as qube_servo2_usb or \
     qube_servo3_usb and a number, as in hil:qube_servo2_usb@0"
)]
pub struct NotAnAddress(String);

impl HilAddress {
    /// Returns whether a device's name begins like the address of a card, valid or not.
    #[must_use]
    pub fn is_meant(name: &str) -> bool {
        name == SCHEME || name.starts_with("hil:")
    }

    /// The card type.
    #[must_use]
    pub fn card(&self) -> &str {
        &self.card
    }

    /// The identifier among the cards of this type.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }
}

impl FromStr for HilAddress {
    type Err = NotAnAddress;

    fn from_str(text: &str) -> Result<Self, NotAnAddress> {
        let wrong = || NotAnAddress(text.to_owned());
        let (card, id) = match text.strip_prefix(SCHEME).ok_or_else(wrong)? {
            "" => (USUAL_CARD, FIRST),
            rest => {
                let named = rest.strip_prefix(':').ok_or_else(wrong)?;
                named.split_once('@').unwrap_or((named, FIRST))
            }
        };
        let is_card = |letter: char| letter.is_ascii_alphanumeric() || letter == '_';
        let fits = card.len() <= LONGEST[0] && id.len() <= LONGEST[1];
        if card.is_empty() || id.is_empty() || !fits {
            return Err(wrong());
        }
        if !card.chars().all(is_card) || !id.chars().all(|letter| letter.is_ascii_graphic()) {
            return Err(wrong());
        }
        Ok(Self { card: card.to_owned(), id: id.to_owned() })
    }
}

impl fmt::Display for HilAddress {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{SCHEME}:{}@{}", self.card, self.id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_names_card_and_identifier_and_reads_back() {
        for (text, whole) in [
            ("hil", "hil:qube_servo2_usb@0"),
            ("hil:qube_servo3_usb", "hil:qube_servo3_usb@0"),
            ("hil:qube_servo3_usb@1", "hil:qube_servo3_usb@1"),
            (
                "hil:qube_servo2_usb@0@tcpip://localhost:18921",
                "hil:qube_servo2_usb@0@tcpip://localhost:18921",
            ),
        ] {
            let address: HilAddress = text.parse().unwrap();
            assert_eq!(address.to_string(), whole);
            assert_eq!(whole.parse(), Ok(address));
        }
    }

    #[test]
    fn a_text_that_names_no_card_is_refused_with_an_example() {
        let long = format!("hil:{}", "q".repeat(65));
        for text in
            ["hil:", "hilda", "hil:@0", "hil:qube@", "hil:a b@0", "hil:q@0\n", "hil:q\0@0", &long]
        {
            let error = text.parse::<HilAddress>().unwrap_err().to_string();
            assert!(error.contains("hil:qube_servo2_usb@0"), "{error}");
        }
    }

    #[test]
    fn a_port_is_no_address() {
        for port in ["/dev/ttyACM0", "hilda", "/dev/hil:0", "emulated"] {
            assert!(!HilAddress::is_meant(port), "{port}");
        }
        assert!(HilAddress::is_meant("hil") && HilAddress::is_meant("hil:"));
    }
}
