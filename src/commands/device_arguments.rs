use std::path::{Path, PathBuf};

use clap::ValueEnum;

use super::chosen_device::{ChosenDevice, EMULATED};
use super::exit::Failure;
use super::failures;
use super::file_kind::FileKind;
use super::plant_file::PlantArgument;
use super::printable::print_message;
use super::profile;
use crate::control::HomingMethod;
use crate::qube::{PlantModel, Profile};
use crate::rig::{ClockChoice, DeviceChoice, QUBE_FILE, QubeFile, RigError};
use crate::safety::PlantConsent;

/// The arguments that select a Qube and a clock.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct DeviceArguments {
    #[command(flatten)]
    qube: QubeArguments,

    #[command(flatten)]
    timed_plant: TimedPlantArguments,
}

/// The arguments that select the clock and the plant that is driven.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct TimedPlantArguments {
    /// Clock: `virtual` runs the emulated Qube as fast as the processor can [default: wall]
    #[arg(long, value_enum)]
    clock: Option<ClockArgument>,

    #[command(flatten)]
    plant: DrivenPlantArguments,
}

/// The arguments that select the plant that is driven.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct DrivenPlantArguments {
    #[command(flatten)]
    plant: PlantArgument,

    /// Drive hardware as a --plant that differs from a Qube in more than smaller limits or a lower
    /// motor rating: guard and homing then rely on the values in its file
    #[arg(long)]
    accept_plant: bool,
}

/// The arguments that select a Qube.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct QubeArguments {
    /// `emulated`, the serial port of a Qube's board, or `hil:CARD@ID` for a Qube with the USB
    /// panel through the vendor's library (`hil`: qube_servo2_usb@0) [default: the port in --qube,
    /// else emulated]
    #[arg(long, value_name = "emulated|PORT|hil:CARD@ID")]
    device: Option<String>,

    /// File with this Qube's properties (signs, port, limits), as `check --write` writes it
    /// [default if --device names a real Qube: qube.toml, if it exists]
    #[arg(long, value_name = "FILE")]
    qube: Option<PathBuf>,

    #[command(flatten)]
    treatment: TreatmentArguments,
}

/// The arguments for the treatment of a Qube, emulated or real.
#[derive(Clone, Copy, Debug, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct TreatmentArguments {
    /// Method that finds the arm's middle: between its stops, or where the operator put it by hand
    /// [default: as the --qube file says, else stops]
    #[arg(long, value_enum)]
    home: Option<HomeArgument>,

    /// Guard the emulated Qube like one that is not identified [default: it counts as identified,
    /// known as well as `lab`]
    #[arg(long, conflicts_with = "qube")]
    unidentified: bool,
}

/// The clocks by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ClockArgument {
    /// Real time
    Wall,
    /// Computed time, for the emulated Qube only; the same seed gives the same bytes
    Virtual,
}

/// The methods of homing by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum HomeArgument {
    /// Half-way between the hard stops, which the arm touches slowly
    Stops,
    /// The arm's present position: put it into the middle before
    Hand,
}

impl HomeArgument {
    fn method(self) -> HomingMethod {
        match self {
            Self::Stops => HomingMethod::Stops,
            Self::Hand => HomingMethod::Hand,
        }
    }
}

impl TimedPlantArguments {
    /// Returns the clock that `--clock` names, if any.
    pub fn clock(&self) -> Option<ClockChoice> {
        Some(match self.clock? {
            ClockArgument::Wall => ClockChoice::Wall,
            ClockArgument::Virtual => ClockChoice::Virtual,
        })
    }
}

impl DeviceArguments {
    /// Selects the Qube like [`QubeArguments::choose`], with the requested clock.
    pub fn choose(&self) -> Result<ChosenDevice, Failure> {
        self.qube.choose_timed(&self.timed_plant)
    }
}

impl QubeArguments {
    /// Returns the arguments of one Qube among several.
    pub fn of_one(
        device: Option<String>,
        qube: Option<PathBuf>,
        treatment: TreatmentArguments,
    ) -> Self {
        Self { device, qube, treatment }
    }

    /// Selects the Qube like [`choose`](Self::choose), with the requested clock.
    pub fn choose_timed(&self, timed: &TimedPlantArguments) -> Result<ChosenDevice, Failure> {
        let clock = timed.clock().unwrap_or(ClockChoice::Wall);
        let chosen = ChosenDevice { clock, ..self.selected(&timed.plant)? };
        // The rig refuses this too, but only after a command has announced its work.
        if let (ClockChoice::Virtual, Some(port)) = (clock, chosen.choice.name()) {
            return Err(failures::virtual_port(&RigError::VirtualPort { port }));
        }
        self.announce(&chosen);
        Ok(chosen)
    }

    /// Reads the file with the Qube's properties, if there is one, and selects the Qube, or the
    /// other plant that is driven in its place. An emulated Qube is put into virtual time.
    ///
    /// The file `qube.toml` in the working directory counts only if `--device` names a real Qube:
    /// without `--device` and `--qube` nothing but the emulated Qube moves, even if that file
    /// exists.
    pub fn choose(&self, driven: &DrivenPlantArguments) -> Result<ChosenDevice, Failure> {
        let chosen = self.selected(driven)?;
        self.announce(&chosen);
        Ok(chosen)
    }

    /// Prints the file whose settings are used, or a note that the file of a real Qube in the
    /// working directory is not used; then notices about homing and profile.
    fn announce(&self, chosen: &ChosenDevice) {
        if let Some(path) = &chosen.path {
            print_message(&format!("this Qube's settings are those in {}", path.display()));
        } else if self.device.is_none() && Path::new(QUBE_FILE).exists() {
            print_message(&format!(
                "note: the emulated Qube is driven. For the one that {QUBE_FILE} describes, give --qube {QUBE_FILE}"
            ));
        }
        if let Some(notice) = chosen.homing_notice() {
            print_message(&format!("note: {notice}"));
        }
        if let Some(warning) = chosen.profile_warning() {
            print_message(&format!("warning: {warning}"));
        }
    }

    fn selected(&self, driven: &DrivenPlantArguments) -> Result<ChosenDevice, Failure> {
        let given = driven.plant.given()?;
        let chosen = ChosenDevice {
            plant_is_given: given.is_some(),
            plant_consent: PlantConsent::given(driven.accept_plant),
            ..self.choose_specimen(&given.unwrap_or_default())?
        };
        chosen.check_plant(&chosen.plant)?;
        if let (true, Some(port)) = (self.treatment.unidentified, chosen.choice.name()) {
            return Err(Failure::usage(format!(
                "--unidentified is for the emulated Qube, and {port} is a real one: to have it guarded as an unidentified \
                 one, leave the profile out of its {QUBE_FILE}"
            )));
        }
        Ok(chosen)
    }

    /// Selects one specimen of this plant, emulated or real.
    fn choose_specimen(&self, plant: &PlantModel) -> Result<ChosenDevice, Failure> {
        let path = match (&self.qube, self.device.as_deref()) {
            (Some(path), _) => Some(path.as_path()),
            (None, None | Some(EMULATED)) => None,
            (None, Some(_)) => Some(Path::new(QUBE_FILE)).filter(|path| path.exists()),
        };
        let load = |path| QubeFile::load(path).map_err(|error| FileKind::Qube.refused(path, error));
        let file = path.map(load).transpose()?;
        let port_of_file = file.as_ref().and_then(|file| file.port.clone());
        let choice = match (self.device.as_deref(), path) {
            (Some(EMULATED), _) | (None, None) => DeviceChoice::Emulated,
            (Some(port), _) => DeviceChoice::named(port)
                .map_err(|error| Failure::usage(format!("--device: {error}")))?,
            (None, Some(path)) => {
                let Some(port) = port_of_file else {
                    let message = format!("{} names no port: give --device too", path.display());
                    return Err(Failure::usage(message));
                };
                DeviceChoice::named(&port)
                    .map_err(|error| Failure::usage(format!("{}: {error}", path.display())))?
            }
        };
        let clock = match choice {
            DeviceChoice::Emulated => ClockChoice::Virtual,
            DeviceChoice::Port(_) | DeviceChoice::Hil(_) | DeviceChoice::Other(_) => {
                ClockChoice::Wall
            }
        };
        let named = file.as_ref().and_then(|file| file.profile.as_deref());
        let folder = path.and_then(Path::parent).unwrap_or(Path::new(""));
        let profile = named.map(|named| profile::load(&folder.join(named), plant)).transpose()?;
        if let (Some(file), Some(profile), Some(path)) = (&file, &profile, path) {
            check_boards(path, file, profile)?;
        }
        Ok(ChosenDevice {
            choice,
            clock,
            plant: *plant,
            plant_is_given: false,
            plant_consent: None,
            profile,
            unidentified: self.treatment.unidentified,
            path: path.map(Path::to_owned),
            file,
            home: self.treatment.home.map(HomeArgument::method),
        })
    }
}

/// Refuses a profile if another board than the one in the file that names the profile made any of
/// the fitted recordings. Without this check the Qube would be driven as one that is not
/// identified.
fn check_boards(path: &Path, file: &QubeFile, profile: &Profile) -> Result<(), Failure> {
    let Some(board) = file.board.as_ref().filter(|board| !profile.may_be_of_board(board)) else {
        return Ok(());
    };
    Err(Failure::usage(format!(
        "{}: the profile {} was identified from recordings of the board {}, and this board is {board}. Record this \
         Qube with qube-hil run --excite chirp --device PORT, and identify it anew",
        path.display(),
        file.profile.as_deref().unwrap_or(Path::new("")).display(),
        profile.boards().join(", "),
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::chosen_device::method_name;
    use crate::control::HomingSettings;

    #[test]
    fn a_profile_that_was_identified_on_another_board_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("qube.toml");
        let profile = Some(PathBuf::from("mine.toml"));
        let file = QubeFile { board: Some("B2".into()), profile, ..QubeFile::default() };
        file.save(&path, "a test").unwrap();
        let chosen_at = |device: &str, boards: &[&str]| {
            let mut profile = Profile::lab();
            profile.provenance.as_mut().unwrap().boards =
                boards.iter().map(ToString::to_string).collect();
            let text = toml::to_string(&profile).unwrap();
            std::fs::write(directory.path().join("mine.toml"), text).unwrap();
            let treatment = TreatmentArguments { home: None, unidentified: false };
            QubeArguments::of_one(Some(device.to_owned()), Some(path.clone()), treatment)
                .choose_specimen(&PlantModel::QUBE)
        };
        let chosen = |boards: &[&str]| chosen_at("/dev/ttyACM0", boards);
        let warning = chosen(&[]).unwrap().profile_warning().unwrap();
        assert!(warning.contains("mine.toml") && warning.contains("B2"), "{warning}");
        assert_eq!(chosen_at(EMULATED, &[]).unwrap().profile_warning(), None);
        assert_eq!(chosen(&["B2"]).unwrap().profile_warning(), None);
        for boards in [&["0000000000000000"][..], &["B2", "C3"]] {
            let message = chosen(boards).err().unwrap().to_string();
            assert!(message.contains(&boards.join(", ")) && message.contains("B2"), "{message}");
        }
    }

    #[test]
    fn a_hint_to_resume_keeps_a_homing_that_the_qubes_file_would_replace() {
        for home in HomeArgument::value_variants() {
            assert_eq!(home.to_possible_value().unwrap().get_name(), method_name(home.method()));
        }
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("qube.toml");
        QubeFile::default().save(&path, "a test").unwrap();
        let chosen = |file: Option<&Path>, home| {
            let treatment = TreatmentArguments { home, unidentified: false };
            let device = Some(EMULATED.to_owned());
            let one = QubeArguments::of_one(device, file.map(Path::to_owned), treatment);
            one.choose_specimen(&PlantModel::QUBE).unwrap()
        };
        let by_hand = chosen(Some(&path), Some(HomeArgument::Hand));
        assert_eq!(by_hand.home_option(), " --home hand");
        assert_eq!(chosen(Some(&path), None).home_option(), "");
        assert_eq!(chosen(None, Some(HomeArgument::Hand)).home_option(), "");
    }

    #[test]
    fn resumed_work_on_a_real_qube_is_homed_by_hand_only_where_the_command_line_says_so() {
        let by_hand = HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("qube.toml");
        std::fs::write(&path, "[homing]\nmethod = \"hand\"\n").unwrap();
        let checked_with = |file: Option<&Path>, device: &str, home| {
            let treatment = TreatmentArguments { home, unidentified: false };
            let file = file.map(Path::to_owned);
            let one = QubeArguments::of_one(Some(device.to_owned()), file, treatment);
            let chosen = one.choose_specimen(&PlantModel::QUBE).unwrap();
            (chosen.check_resumed("a session", false, by_hand), chosen.home_option())
        };
        let checked = |device: &str, home| checked_with(None, device, home);
        let (refused, option) = checked_with(Some(&path), "/dev/ttyACM0", None);
        assert!(refused.is_err());
        assert_eq!(option, " --home hand", "the file says hand");
        let (refused, _) = checked("/dev/ttyACM0", None);
        assert!(refused.unwrap_err().to_string().contains("give --home hand"));
        let (admitted, option) = checked("/dev/ttyACM0", Some(HomeArgument::Hand));
        assert!(admitted.is_ok());
        assert_eq!(option, " --home hand", "the command to resume needs it");
        assert!(checked(EMULATED, None).0.is_ok());
    }

    #[test]
    fn a_file_that_replaces_homing_at_the_stops_of_a_real_qube_is_reported() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("qube.toml");
        let notice = |method: &str, device: &str, home| {
            std::fs::write(&path, format!("[homing]\nmethod = {method:?}\n")).unwrap();
            let treatment = TreatmentArguments { home, unidentified: false };
            let one = QubeArguments::of_one(Some(device.into()), Some(path.clone()), treatment);
            one.choose_specimen(&PlantModel::QUBE).unwrap().homing_notice()
        };
        // Files of earlier versions call the method `here`.
        for method in ["hand", "here"] {
            let notice_text = notice(method, "/dev/ttyACM0", None).unwrap();
            assert!(notice_text.contains("counts as the middle"), "{notice_text}");
            assert_eq!(notice(method, EMULATED, None), None);
            assert_eq!(notice(method, "/dev/ttyACM0", Some(HomeArgument::Hand)), None);
        }
        assert_eq!(notice("stops", "/dev/ttyACM0", None), None);
    }
}
