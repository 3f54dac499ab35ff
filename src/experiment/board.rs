//! Binds an experiment on a real Qube to one board, because its results are compared.

use super::{Experiment, ExperimentError};
use crate::recording::{RecordingError, read};
use crate::rig::RigSettings;
use crate::session::{RolloutAttempt, SessionPaths, SessionView, keep_on_board, recording_in};
use crate::storage::MachineDisk;

impl Experiment {
    /// The settings of the rig. A real Qube is bound to the board that made the experiment's first
    /// recording, so that no other board is driven.
    ///
    /// # Errors
    /// A search or a recording cannot be read, or the settings of the rig are for another board. A
    /// damaged recording is passed over.
    pub(super) fn rig_on_the_same_board(&self) -> Result<RigSettings, ExperimentError> {
        let mut rig = self.rig().clone();
        if !rig.is_hardware() {
            return Ok(rig);
        }
        if let Some(before) = self.first_board()? {
            keep_on_board(&mut rig, before)?;
        }
        Ok(rig)
    }

    /// Serial number of the board that made the first recording; `None` if there is no recording or
    /// it names no board.
    fn first_board(&self) -> Result<Option<String>, ExperimentError> {
        let settings = self.settings();
        let mut paths = Vec::new();
        for recipe in &settings.recipes {
            let search = SessionPaths::new(&self.folder().search(&recipe.name));
            let view = SessionView::read(&MachineDisk, search.clone())?;
            for candidate in view.state().candidates() {
                let recorded = candidate.finished.iter();
                let of_candidate = search.candidate(candidate.number);
                paths.extend(recorded.map(|it| of_candidate.rollout(it.of_policy())));
            }
        }
        for recipe in &settings.recipes {
            let folders = self.folder().policies(&recipe.name);
            let folder = |policy| folders.rollouts(policy, &settings.plants[0].name);
            let first = |policy| recording_in(&folder(policy), RolloutAttempt::FIRST);
            paths.extend((0..settings.policies).map(first));
        }
        for path in &paths {
            match read(path) {
                Ok(recording) => return Ok(recording.header.board().map(str::to_owned)),
                // A crash may have left a recording that will be made again.
                Err(RecordingError::Unreadable { .. }) => {}
                Err(error) if error.is_absence() => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;

    use super::*;
    use crate::experiment::{ExperimentFolder, ExperimentSettings, Plant, Recipe};
    use crate::qube::Profile;
    use crate::recording::{RolloutWriter, samples};
    use crate::rig::DeviceChoice;
    use crate::session::SessionSettings;
    use crate::simulation::Model;
    use crate::telemetry::DeviceFacts;

    fn experiment(root: &Path, device: DeviceChoice, board: Option<&str>) -> Experiment {
        let plant = Plant { name: "device".into(), emulated: Default::default(), vary: 0.0 };
        let settings = ExperimentSettings {
            name: "table".into(),
            seed: 7,
            policies: 2,
            rollouts: 1,
            simulated_starts: 1,
            guard_profile: None,
            plants: vec![plant],
            recipes: vec![Recipe::of(Model::Nominal, &SessionSettings::thesis())],
            methods: None,
        };
        let folder = match ExperimentFolder::open(root) {
            Ok(folder) => folder,
            Err(_) => ExperimentFolder::create(root, &settings.to_toml().unwrap()).unwrap(),
        };
        let board = board.map(str::to_owned);
        let profile = Some(Profile::lab());
        let rig = RigSettings { board, profile, ..RigSettings::in_virtual_time(device) };
        Experiment::new(folder, settings, rig, 1, Arc::default())
    }

    fn record(experiment: &Experiment, policy: u32, serial: &str) {
        let folder = experiment.folder().policies("nominal").rollouts(policy, "device");
        std::fs::create_dir_all(&folder).unwrap();
        let mut header = samples::header();
        header.device.insert(DeviceFacts::SERIAL, serial);
        let path = recording_in(&folder, RolloutAttempt::FIRST);
        let writer = RolloutWriter::create(&MachineDisk, &path, header, samples::POLICY).unwrap();
        writer.finish(&samples::outcome()).unwrap();
    }

    #[test]
    fn an_experiment_on_a_real_qube_stays_on_the_board_of_its_first_recording() {
        let root = tempfile::tempdir().unwrap();
        let port = || DeviceChoice::Port("/dev/no-such-qube".into());
        let bound = |device, board| {
            let rig = experiment(root.path(), device, board).rig_on_the_same_board()?;
            Ok::<_, ExperimentError>((rig.board.clone(), rig.identified().is_some()))
        };
        assert_eq!(bound(port(), None).unwrap(), (None, false));
        assert_eq!(bound(port(), Some("two")).unwrap(), (Some("two".into()), true));
        {
            let begun = experiment(root.path(), port(), None);
            record(&begun, 1, "three");
            record(&begun, 0, "one");
        }
        // A profile counts for the guard only if the Qube's file names its board.
        assert_eq!(bound(port(), None).unwrap(), (Some("one".into()), false));
        assert_eq!(bound(port(), Some("one")).unwrap(), (Some("one".into()), true));
        let message = bound(port(), Some("two")).unwrap_err().to_string();
        assert!(message.contains("board two is named in the place of board one"), "{message}");
        // The board of an unreadable recording is unknown, so no other board is driven.
        {
            let begun = experiment(root.path(), port(), None);
            let folder = begun.folder().policies("nominal").rollouts(0, "device");
            let path = recording_in(&folder, RolloutAttempt::FIRST);
            let aside = path.with_extension("aside");
            std::fs::rename(&path, &aside).unwrap();
            std::os::unix::fs::symlink(&path, &path).unwrap();
            assert!(begun.rig_on_the_same_board().is_err());
            std::fs::rename(&aside, &path).unwrap();
        }
        // Each rollout on an emulated Qube has a board of its own.
        assert_eq!(bound(DeviceChoice::Emulated, None).unwrap(), (None, true));
    }
}
