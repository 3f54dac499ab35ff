use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::PathBuf;

use safetensors::{SafeTensorError, SafeTensors};

use super::curve::TrainUpdate;
use super::network::Network;
use super::optimise::Learner;
use super::state::TrainingState;
use super::tensors::{Tensor, TensorDefect, f32s, f64s, pair, tensor_views, u64s};
use super::{TrainError, TrainSettings};
use crate::storage::{MachineDisk, checksum_of, read_bounded, write_whole};

/// Largest checkpoint that is read, bytes. A training with the thesis's settings writes about 150
/// kB, a training of a million updates 104 MB, nearly all of it the learning curve.
const MAX_FILE_BYTES: u64 = 128 << 20;

/// Name of the checksum of the tensors in a checkpoint's metadata. Checkpoints of earlier versions
/// have none.
const CHECKSUM: &str = "checksum";

/// Version of the checkpoint's content; every change of the content increments it.
const VERSION: &str = "3";

/// File and interval of the checkpoints from which an interrupted training resumes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Checkpointing {
    /// Path of the checkpoint. Training resumes from an existing file. A finished training leaves
    /// the file; the caller removes it ([`Self::remove`]) once the policy is on the disk.
    pub path: PathBuf,
    /// Number of updates between checkpoints; 0 counts as 1.
    pub every: u32,
}

impl Checkpointing {
    /// Returns whether a checkpoint is due after this many updates.
    pub(super) fn is_due(&self, updates: usize) -> bool {
        updates.is_multiple_of(self.every.max(1) as usize)
    }

    /// Removes the file of a finished training, if there is one.
    ///
    /// # Errors
    /// The operating system refuses.
    pub fn remove(&self) -> Result<(), TrainError> {
        match fs::remove_file(&self.path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(self.file_error(error)),
            _ => Ok(()),
        }
    }

    /// Writes everything that the next update depends on. The file is replaced atomically: after a
    /// crash the path holds either the old file or the new one.
    pub(super) fn write(&self, training: &TrainingState<'_>) -> Result<(), TrainError> {
        let bytes = to_bytes(training).map_err(|error| self.damaged(error.to_string()))?;
        write_whole(&MachineDisk, &self.path, &bytes).map_err(|error| self.file_error(error.source))
    }

    /// Restores a new training from the file; does nothing when there is no file.
    pub(super) fn resume(&self, training: &mut TrainingState<'_>) -> Result<(), TrainError> {
        let bytes = match read_bounded(&self.path, MAX_FILE_BYTES) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(self.file_error(error)),
        };
        let damaged = |error: SafeTensorError| self.damaged(error.to_string());
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
        let found = header.metadata().clone().unwrap_or_default();
        for (property, expected) in identity(training) {
            match found.get(property) {
                Some(value) if *value == expected => {}
                Some(_) => {
                    return Err(TrainError::CheckpointOfAnother {
                        path: self.path.clone(),
                        property,
                    });
                }
                None => return Err(self.damaged(format!("its {property} is missing"))),
            }
        }
        let tensors = SafeTensors::deserialize(&bytes).map_err(damaged)?;
        let contents = tensors.iter().map(|(name, tensor)| (name, tensor.data()));
        if found.get(CHECKSUM).is_some_and(|it| *it != checksum(contents)) {
            return Err(self.damaged("its values do not match their checksum".to_owned()));
        }
        from_tensors(&tensors, training).map_err(|defect| self.damaged(defect.to_string()))
    }

    fn file_error(&self, source: io::Error) -> TrainError {
        TrainError::CheckpointFile { path: self.path.clone(), source }
    }

    fn damaged(&self, reason: String) -> TrainError {
        TrainError::CheckpointDamaged { path: self.path.clone(), reason }
    }
}

/// The properties that two trainings must share for one to resume the other, by the names that
/// error messages use.
fn identity(training: &TrainingState<'_>) -> [(&'static str, String); 4] {
    // The number of threads does not change the result.
    let settings = TrainSettings { threads: 0, ..training.settings.clone() };
    [
        ("format version", VERSION.to_owned()),
        ("seed", training.seed.to_string()),
        ("settings", recorded_names(&format!("{settings:?}"))),
        ("distribution", format!("{:?}", training.distribution)),
    ]
}

/// Replaces the names of settings by the names that checkpoints record. The recorded names do not
/// change when a setting is renamed, so that the settings of an older checkpoint match.
fn recorded_names(settings: &str) -> String {
    [("num_envs:", "pendulums:"), ("gae_lambda:", "trace_decay:"), ("target_return:", "enough:")]
        .iter()
        .fold(settings.to_owned(), |text, (name, recorded)| text.replace(name, recorded))
}

/// The networks and Adam's moments with their names in the file.
fn networks<'a>(training: &'a TrainingState<'_>) -> [(&'static str, &'a Network); 7] {
    let (policy, value) = (&training.policy, &training.value);
    [
        ("policy", &policy.network),
        ("policy.first_moment", &policy.moments.first),
        ("policy.second_moment", &policy.moments.second),
        ("value", &value.network),
        ("value.first_moment", &value.moments.first),
        ("value.second_moment", &value.moments.second),
        ("best", &training.best),
    ]
}

fn to_bytes(training: &TrainingState<'_>) -> Result<Vec<u8>, SafeTensorError> {
    let of_network = |(name, network): (&'static str, &Network)| {
        Tensor::of_f32s(name, network.slices().into_iter().flatten().copied())
    };
    let mut tensors: Vec<Tensor> = networks(training).into_iter().map(of_network).collect();
    let curve = training.curve.iter().flat_map(|update| update.to_array());
    let counters = [training.policy.moments.steps, training.value.moments.steps];
    tensors.push(Tensor::of_f64s("curve", curve));
    tensors.push(Tensor::of_f64s("best_return", [training.best_return, training.best_score]));
    tensors.push(Tensor::of_u64s("counters", counters));

    let checksum = checksum(tensors.iter().map(|it| (it.name, it.bytes.as_slice())));
    let metadata: HashMap<String, String> = identity(training)
        .into_iter()
        .chain([(CHECKSUM, checksum)])
        .map(|(name, value)| (name.to_owned(), value))
        .collect();
    safetensors::serialize(tensor_views(&tensors)?, Some(metadata))
}

/// The checksum of named tensors, whatever their order.
fn checksum<'a>(tensors: impl Iterator<Item = (&'a str, &'a [u8])>) -> String {
    let mut checksums: Vec<String> =
        tensors.map(|(name, bytes)| format!("{name} {}\n", checksum_of(bytes))).collect();
    checksums.sort();
    checksum_of(checksums.concat().as_bytes())
}

fn from_tensors(
    tensors: &SafeTensors<'_>,
    training: &mut TrainingState<'_>,
) -> Result<(), TensorDefect> {
    let network = |name: &str, network: &mut Network| {
        let mut values = f32s(tensors, name)?;
        let expected: usize = network.slices().iter().map(|slice| slice.len()).sum();
        if values.len() != expected {
            let (name, values) = (name.to_owned(), values.len());
            return Err(TensorDefect::Count { name, values, expected });
        }
        for slice in network.slices_mut() {
            slice.fill_with(|| values.next().unwrap_or_default());
        }
        Ok(())
    };
    let learner = |name: &str, learner: &mut Learner| {
        network(name, &mut learner.network)?;
        network(&format!("{name}.first_moment"), &mut learner.moments.first)?;
        network(&format!("{name}.second_moment"), &mut learner.moments.second)
    };
    learner("policy", &mut training.policy)?;
    learner("value", &mut training.value)?;
    network("best", &mut training.best)?;

    [training.best_return, training.best_score] =
        pair("best_return", f64s(tensors, "best_return")?)?;
    let curve = f64s(tensors, "curve")?;
    training.curve = curve.as_chunks().0.iter().map(TrainUpdate::from_array).collect();
    [training.policy.moments.steps, training.value.moments.steps] =
        pair("counters", u64s(tensors, "counters")?)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::DomainDistribution;

    #[test]
    fn a_changed_bit_of_any_value_is_found() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("checkpoint");
        let settings = TrainSettings::quick();
        let distribution = DomainDistribution::nominal();
        let new = || TrainingState::new(&distribution, &settings, None, 1);
        let checkpointing = Checkpointing { path: path.clone(), every: 1 };
        checkpointing.write(&new()).unwrap();
        assert!(checkpointing.resume(&mut new()).is_ok());
        let whole = fs::read(&path).unwrap();
        let header = u64::from_le_bytes(*whole.first_chunk().unwrap()) as usize + 8;
        for place in [header, header + (whole.len() - header) / 2, whole.len() - 1] {
            let mut damaged = whole.clone();
            damaged[place] ^= 0x40;
            fs::write(&path, &damaged).unwrap();
            let refused = checkpointing.resume(&mut new()).unwrap_err().to_string();
            assert!(refused.contains("checksum"), "{place}: {refused}");
        }
    }

    #[test]
    fn the_checkpoint_of_the_longest_training_can_be_read() {
        let longest = TrainSettings { updates: 1_000_000, ..TrainSettings::quick() };
        assert!(longest.check().is_ok());
        let distribution = DomainDistribution::nominal();
        let mut training = TrainingState::new(&distribution, &longest, None, 1);
        let empty = to_bytes(&training).unwrap().len() as u64;
        training.curve.push(TrainUpdate::default());
        let of_update = size_of_val(&training.curve[0].to_array()) as u64;
        assert!(empty + u64::from(longest.updates) * of_update <= MAX_FILE_BYTES);
        let beyond = TrainSettings { updates: longest.updates + 1, ..longest.clone() };
        assert!(beyond.check().is_err());
    }
}
