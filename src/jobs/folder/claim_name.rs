use std::fmt;

/// Largest number of a try. A file with a larger number is a stray one: a job is given up or done
/// after a few tries.
const LAST_TRY: u32 = 99_999;

/// The name of the file by which a worker claims a try of a job: `FINGERPRINT.N`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClaimName<'a> {
    /// Name of the job.
    pub job: &'a str,
    /// Number of the try, from 0.
    pub number: u32,
}

impl<'a> ClaimName<'a> {
    /// The parts of a file's name; `None` if it is not the name of a claim.
    #[must_use]
    pub fn parse(name: &'a str) -> Option<Self> {
        let (job, number) = name.rsplit_once('.')?;
        let number = number.parse().ok().filter(|&number| number <= LAST_TRY)?;
        Some(Self { job, number })
    }
}

impl fmt::Display for ClaimName<'_> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}.{}", self.job, self.number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_claim_is_parsed_as_it_was_written() {
        let third = ClaimName { job: "0f.3a", number: 2 };
        assert_eq!(third.to_string(), "0f.3a.2");
        assert_eq!(ClaimName::parse("0f.3a.2"), Some(third));
        for other in ["0f3a", "0f3a.", "0f3a.-1", "0f3a.refused", "0f3a.100000", "0f3a.4294967295"]
        {
            assert_eq!(ClaimName::parse(other), None, "{other}");
        }
    }
}
