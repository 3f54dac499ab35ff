use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{PsiError, PsiTarget};
use crate::qube::{Quantity, key_of_message, line_of_key};
use crate::storage::{SETTINGS_BYTES, read_text};

/// A psi: the parameters of the distribution over simulations that a search varies. Every value is
/// physical; a [`super::PsiSpace`] is the box in which a search looks for a psi.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "BTreeMap<String, f64>", into = "BTreeMap<String, f64>")]
pub struct Psi {
    values: Vec<(PsiTarget, f64)>,
}

impl Psi {
    /// A psi with these entries, which are kept in this order.
    ///
    /// # Errors
    /// A value is not physical.
    pub fn new(values: Vec<(PsiTarget, f64)>) -> Result<Self, PsiError> {
        for (target, value) in &values {
            target.check(*value)?;
        }
        Ok(Self { values })
    }

    /// The values by name.
    #[must_use]
    pub fn named_values(&self) -> BTreeMap<String, f64> {
        self.values.iter().map(|(target, value)| (target.to_string(), *value)).collect()
    }

    /// The value of one entry; `None` if psi does not name it.
    #[must_use]
    pub fn get(&self, target: PsiTarget) -> Option<f64> {
        self.values.iter().find(|(own, _)| *own == target).map(|(_, value)| *value)
    }

    /// The mean and standard deviation that psi gives to a quantity, in the quantity's unit; `None`
    /// for each of the two that psi does not name.
    #[must_use]
    pub fn moments(&self, quantity: Quantity) -> (Option<f64>, Option<f64>) {
        let (mean, deviation) = (PsiTarget::Mean(quantity), PsiTarget::StandardDeviation(quantity));
        (self.get(mean), self.get(deviation))
    }

    /// The corner frequency of the simulated velocity filter, rad/s; `None` if psi does not name
    /// it.
    #[must_use]
    pub fn filter_corner_rad_s(&self) -> Option<f64> {
        self.get(PsiTarget::Filter)
    }

    /// Reads a TOML file with one line `name = value` for each entry.
    ///
    /// # Errors
    /// The file cannot be read or is not TOML, has no entry, an entry with an unknown name or the
    /// same entry twice, or a value is not physical.
    pub fn load(path: &Path) -> Result<Self, PsiError> {
        let text = read_text(path, SETTINGS_BYTES)
            .map_err(|source| PsiError::Unreadable { path: path.to_owned(), source })?;
        let named: BTreeMap<String, f64> = toml::from_str(&text).map_err(|source| {
            PsiError::NotPsi { path: path.to_owned(), source: Box::new(source) }
        })?;
        Self::try_from(named).map_err(|error| {
            let message = error.to_string();
            let line = line_of_key(&text, key_of_message(&message), |name, part| name == part);
            PsiError::InFile { path: path.to_owned(), line, error: Box::new(error) }
        })
    }
}

impl TryFrom<BTreeMap<String, f64>> for Psi {
    type Error = PsiError;

    fn try_from(named: BTreeMap<String, f64>) -> Result<Self, PsiError> {
        let values = named
            .into_iter()
            .map(|(name, value)| Ok((PsiTarget::from_name(&name)?, value)))
            .collect::<Result<Vec<_>, PsiError>>()?;
        if values.is_empty() {
            return Err(PsiError::NoDimensions);
        }
        Self::new(values)
    }
}

impl From<Psi> for BTreeMap<String, f64> {
    fn from(psi: Psi) -> Self {
        psi.named_values()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameter, Nonideality};

    #[test]
    fn a_file_is_read_and_an_error_names_its_defect() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("psi.toml");
        let load = |text: &str| {
            std::fs::write(&path, text).unwrap();
            Psi::load(&path)
        };
        // The thesis's eight entries in the form that earlier versions wrote.
        let text = "mean_M_p = 0.02\nstd_M_p = 0.001\nmean_M_r = 0.09\nstd_M_r = 0.002\n\
                    mean_L_p = 0.12\nstd_L_p = 0.003\nmean_L_r = 0.08\nstd_L_r = 0.004\n";
        let psi = load(text).unwrap();
        let moments = |parameter: DomainParameter| psi.moments(parameter.into());
        assert_eq!(moments(DomainParameter::PendulumMass), (Some(0.02), Some(0.001)));
        assert_eq!(moments(DomainParameter::RotaryLength), (Some(0.08), Some(0.004)));
        assert_eq!(moments(DomainParameter::Gravity), (None, None));
        assert_eq!(
            load(&toml::to_string(&psi).unwrap()).unwrap().named_values(),
            psi.named_values()
        );

        let short = load("mean_delay = 0.01\nfilter = 50\n").unwrap();
        assert_eq!(short.moments(Nonideality::CommandDelay.into()), (Some(0.01), None));
        assert_eq!(short.filter_corner_rad_s(), Some(50.0));

        for (text, words) in [
            ("filter = 50\nmean_M_x = 1.0\n", "psi.toml, line 2: mean_M_x is no entry"),
            ("mean_M_p = -1.0\n", "psi.toml, line 1: mean_M_p = -1"),
            ("std_M_p = nan\n", "std_M_p"),
            ("mean_delay = 6.0\n", "delay"),
            ("mean_M_p = 0.02\nmean_M_p = 0.03\n", "duplicate"),
            ("", "no entry"),
        ] {
            let message = load(text).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains("psi.toml"), "{message}");
        }
        let message = Psi::load(&directory.path().join("none.toml")).unwrap_err().to_string();
        assert!(message.contains("none.toml: cannot be read"), "{message}");
    }
}
