//! Keeps a session on the boards that made its first recordings.

use super::Session;
use crate::device::{EMULATOR_KIND, IN_PROCESS};
use crate::rig::{DeviceChoice, RigSettings};
use crate::scoring::read_finished;
use crate::session::SessionError;
use crate::telemetry::DeviceFacts;

/// Binds a real rig to the board that made its first recording. Drops the profile if the settings
/// name no board.
///
/// # Errors
/// The settings name another board.
pub fn keep_on_board(settings: &mut RigSettings, before: String) -> Result<(), SessionError> {
    match settings.board.replace(before.clone()) {
        Some(now) if now != before => return Err(SessionError::OtherBoard { before, now }),
        Some(_) => {}
        // A profile without a board did not count when the work began, and a recording does not
        // show whose profile it is.
        None => settings.profile = None,
    }
    Ok(())
}

/// Returns whether the embedded emulated Qube may have made a recording with this device in its
/// header. A Qube that `emulate` serves at a port with a name of its own is another one. At a port
/// `/dev/pts/N` it looks the same as the embedded Qube, which has such a port in real time.
fn may_be_embedded(device: &DeviceFacts) -> bool {
    let is_emulator = device.kind().is_none_or(|kind| kind == EMULATOR_KIND);
    let is_unnamed = |port: &str| port == IN_PROCESS || port.starts_with("/dev/pts/");
    is_emulator && device.port().is_none_or(is_unnamed)
}

impl Session {
    /// Binds each real rig to the board that made its first recording in this session, so that the
    /// session drives neither another board nor the embedded emulated Qube in its place. Each run
    /// begins with this check; a caller makes it earlier to refuse before it announces a motion.
    ///
    /// # Errors
    /// A recording cannot be read, or the settings of a rig are for another board, or for the
    /// embedded emulated Qube where another device made the recordings.
    pub fn check_boards(&mut self) -> Result<(), SessionError> {
        for index in 0..self.rigs.len() {
            let Some(device) = self.first_device(self.number_of(index))? else { continue };
            let Some(before) = device.serial().map(str::to_owned) else { continue };
            let settings = &mut self.rigs[index].settings;
            if !settings.is_hardware() {
                let is_emulator = matches!(settings.device, DeviceChoice::Emulated);
                if is_emulator && !may_be_embedded(&device) {
                    let port = device.port().unwrap_or_default().to_owned();
                    return Err(SessionError::EmulatedInPlace { before, port });
                }
                continue;
            }
            keep_on_board(settings, before)?;
        }
        Ok(())
    }

    /// Serial number of the board that made the first finished recording of this rig, or of any rig
    /// if `rig` is `None`. `None` if there is no such recording or it names no board.
    ///
    /// # Errors
    /// The recording cannot be read.
    pub fn board(&self, rig: Option<u32>) -> Result<Option<String>, SessionError> {
        Ok(self.first_device(rig)?.and_then(|device| device.serial().map(str::to_owned)))
    }

    /// The device that made the first finished recording of this rig, or of any rig if `rig` is
    /// `None`, as the recording describes it. `None` if there is no such recording.
    fn first_device(&self, rig: Option<u32>) -> Result<Option<DeviceFacts>, SessionError> {
        let first = self.ledger.state().candidates().iter().find_map(|it| {
            let finished = it.finished.iter().find(|it| rig.is_none() || it.rig == rig)?;
            Some(self.recording(finished.of_candidate(it.number)))
        });
        let Some(first) = first else { return Ok(None) };
        let (recording, _) = read_finished(self.folder.disk(), &first)?;
        Ok(Some(recording.header.device))
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;

    use super::*;
    use crate::device::emulator::EmulatorSettings;
    use crate::qube::Profile;
    use crate::recording::{RolloutWriter, samples};
    use crate::session::{AttemptId, Entry, Purpose, SessionFolder, SessionSettings};
    use crate::storage::MachineDisk;
    use crate::telemetry::RolloutOutcome;

    /// A session on a real Qube whose file names this board and a profile.
    fn session(folder: &Path, board: Option<&str>) -> Session {
        let settings = SessionSettings::quick();
        let folder = match SessionFolder::open(folder) {
            Ok(folder) => folder,
            Err(_) => SessionFolder::create(folder, &settings.to_toml().unwrap()).unwrap(),
        };
        let rig = RigSettings {
            device: DeviceChoice::Port("/dev/no-such-qube".into()),
            board: board.map(str::to_owned),
            profile: Some(Profile::lab()),
            ..RigSettings::emulated(EmulatorSettings::default())
        };
        Session::open(folder, settings, rig, Arc::default()).unwrap()
    }

    /// Enters a rollout on the board `one` at this port into a new session.
    fn record(session: &mut Session, port: &str) {
        let point = session.settings.psi.lower();
        session.folder.make_candidate(0).unwrap();
        for entry in [
            Entry::Proposed {
                candidate: 0,
                purpose: Purpose::Initial,
                point,
                pending: Vec::new(),
                policy_of: None,
            },
            Entry::Trained { candidate: 0, checksum: None },
            Entry::RolloutFinished { candidate: 0, rollout: 0, attempt: 0, rig: None },
        ] {
            session.ledger.append(entry).unwrap();
        }
        let mut header = samples::header();
        header.device = DeviceFacts::from_iter([
            (DeviceFacts::SERIAL, "one"),
            (DeviceFacts::PORT, port),
            (DeviceFacts::KIND, EMULATOR_KIND),
        ]);
        let path = session.recording(AttemptId { candidate: 0, rollout: 0, attempt: 0 });
        let writer = RolloutWriter::create(&MachineDisk, &path, header, samples::POLICY).unwrap();
        writer.finish(&RolloutOutcome { steps: 0, ..samples::outcome() }).unwrap();
    }

    #[test]
    fn a_resumed_session_keeps_its_board_and_drops_a_profile_without_a_board() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("session");
        record(&mut session(&root, None), "/dev/qube");
        let resumed = |board| {
            let mut session = session(&root, board);
            session.check_boards()?;
            let rig = &session.rigs[0].settings;
            Ok::<_, SessionError>((rig.board.clone(), rig.identified().is_some()))
        };
        assert_eq!(resumed(None).unwrap(), (Some("one".into()), false));
        assert_eq!(resumed(Some("one")).unwrap(), (Some("one".into()), true));
        assert!(matches!(resumed(Some("two")), Err(SessionError::OtherBoard { .. })));
    }

    #[test]
    fn no_session_runs_on_another_board() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("session");
        record(&mut session(&root, None), "/dev/qube");
        let refused = session(&root, Some("two")).run(&mut |_| ()).err();
        assert!(matches!(refused, Some(SessionError::OtherBoard { .. })), "{refused:?}");
    }

    #[test]
    fn the_embedded_qube_does_not_replace_a_qube_at_a_port() {
        for (port, is_other) in [("/tmp/qube", true), (IN_PROCESS, false), ("/dev/pts/3", false)] {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().join("session");
            record(&mut session(&root, None), port);
            let mut resumed = session(&root, None);
            resumed.rigs[0].settings.device = DeviceChoice::Emulated;
            let refused = resumed.check_boards().err();
            let is_refused = matches!(refused, Some(SessionError::EmulatedInPlace { .. }));
            assert_eq!(is_refused, is_other, "{port}: {refused:?}");
        }
    }
}
