use super::Identified;
use crate::qube::{Correlations, Profile, Provenance};

impl Identified {
    /// The profile of the identified specimen with the errors of its values. `recordings` are the
    /// names of the fitted files, `boards` the serial numbers of the boards that made them.
    #[must_use]
    pub fn profile(&self, name: &str, recordings: Vec<String>, boards: Vec<String>) -> Profile {
        let named = |unknown: super::Unknown| unknown.name().to_owned();
        let errors = self.estimates.iter().map(|it| (named(it.unknown), it.standard_error));
        let doubts = self.assessment.missing_effects.iter().map(|doubt| doubt.name().to_owned());
        let names = self.estimates.iter().map(|it| named(it.unknown)).collect();
        Profile {
            name: name.to_owned(),
            plant: self.plant,
            parameters: self.model.parameters,
            nonidealities: self.model.nonidealities,
            standard_errors: errors.collect(),
            correlations: Some(Correlations::new(names, &self.correlations)),
            provenance: Some(Provenance {
                recordings,
                boards,
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
                doubts: doubts.collect(),
                held_out_rms_rad: None,
                note: None,
            }),
        }
    }
}
