use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::search::StrategyKind;

/// A method that turns real rollouts into policies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Method {
    /// Searches for psi with a strategy.
    Search(StrategyKind),
    /// Identifies the Qube from recordings under an excitation and trains policies around the result,
    /// without a search.
    Identify,
}

impl Method {
    /// Every method.
    pub fn all() -> impl Iterator<Item = Self> {
        StrategyKind::ALL.into_iter().map(Self::Search).chain([Self::Identify])
    }

    /// The method's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Search(kind) => kind.name(),
            Self::Identify => "identify",
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

impl FromStr for Method {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::all().find(|it| it.name() == name).ok_or_else(|| {
            let known: Vec<&str> = Self::all().map(Self::name).collect();
            format!("there is no strategy {name:?}: choose from {}", known.join(", "))
        })
    }
}

impl TryFrom<String> for Method {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        name.parse()
    }
}

impl From<Method> for String {
    fn from(method: Method) -> Self {
        method.name().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back_to_their_methods() {
        for method in Method::all() {
            assert_eq!(method.name().parse(), Ok(method));
            assert_eq!(serde_json::to_value(method).unwrap(), method.name());
        }
        let message = "baysian".parse::<Method>().unwrap_err();
        assert!(
            message.contains("baysian")
                && message.contains("bayrn, cem, cmaes, random, sobol, identify")
        );
    }
}
