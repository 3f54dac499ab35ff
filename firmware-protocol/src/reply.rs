use crate::EncodedFrame;
use crate::Frame;
use crate::ParseError;
use crate::fields::{Reader, Writer};

const HELLO_REPLY: u8 = 0x81;
const ARM_REPLY: u8 = 0x82;
const SAMPLE_REPLY: u8 = 0x83;
const DISARM_REPLY: u8 = 0x85;
const REFUSAL: u8 = 0x8F;

/// A message from the device to the computer. Its frame carries the sequence number of the request
/// that it answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reply {
    /// Answer to a hello.
    Hello(HelloReply),
    /// Answer to an `Arm` request that was accepted.
    Arm {
        /// Time at which the watchdog began to count, by the device's clock, microseconds.
        device_time_us: u32,
    },
    /// Answer to a sample request.
    Sample(SampleReply),
    /// Answer to a `Disarm` request.
    Disarm(DisarmReply),
    /// Answer to a request that was not carried out.
    Refusal {
        /// Type of the refused request.
        refused_type: u8,
        /// Reason of the refusal.
        reason: RefusalReason,
    },
}

/// Identity of the device. The message's type, its length and its first field are the same in every
/// version of the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HelloReply {
    /// Protocol version of the device.
    pub protocol_version: u16,
    /// Version of the device's firmware: major, minor, patch.
    pub firmware_version: [u8; 3],
    /// Kind of device: a [`DeviceKind`], or a number without a name in this version.
    pub kind: u8,
    /// Module id that the Qube reports; any number other than
    /// [`QUBE_MODULE_ID`](crate::QUBE_MODULE_ID) means that there is no Qube.
    pub module_id: u16,
    /// Serial number of the board.
    pub serial: [u8; 8],
    /// Nonce for the next `Arm` request; 0 if there is none.
    pub nonce: u32,
    /// Number of the device's start: constant while the device runs, another number after its next
    /// start.
    pub boot_id: u16,
    /// Frames dropped since the device started, modulo 2^16.
    pub dropped_frames: u16,
}

/// The answer to a sample request: the readings of one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampleReply {
    /// Time at which the encoders were read, by the device's clock, microseconds modulo 2^32.
    pub device_time_us: u32,
    /// Position of the arm by its encoder, counts: 2048 for a revolution.
    pub theta_counts: i32,
    /// Position of the pendulum by its encoder, counts: 2048 for a revolution.
    pub alpha_counts: i32,
    /// Velocity of the arm by the tachometer, counts/s.
    pub tachometer_counts_s: i32,
    /// Motor current, mA.
    pub current_ma: i16,
    /// The device's flags.
    pub status: StatusBits,
    /// Voltage at the motor when the encoders were read, mV, in the motor's steps of 24 mV; 0 while
    /// the amplifier is off.
    pub applied_mv: i16,
    /// Sequence number of the last accepted act, or of the `Arm` request if no act was accepted
    /// since; 0 from a start or a hello to the next `Arm` request.
    pub last_act_sequence: u16,
    /// Time from the previous sample to the first act accepted after it, microseconds, at most
    /// 65 534; [`NO_ACT_US`](crate::NO_ACT_US) if no act was accepted.
    pub sample_to_act_us: u16,
}

/// The answer to a `Disarm` request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DisarmReply {
    /// State of the device after the request.
    pub state: DeviceState,
    /// Nonce for the next `Arm` request; 0 if a hello must come first.
    pub nonce: u32,
    /// Frames dropped since the device started, modulo 2^16.
    pub dropped_frames: u16,
}

/// Flags of the device, one bit each. Bit 7 is 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StatusBits(pub u8);

impl StatusBits {
    /// Bit 0: the amplifier follows acts.
    pub const ARMED: u8 = 1 << 0;
    /// Bit 1: the watchdog tripped since the last `Arm` request.
    pub const WATCHDOG_TRIPPED: u8 = 1 << 1;
    /// Bit 2: the Qube reports a fault of its amplifier, or such a fault has led to
    /// [`DeviceState::Faulted`] since the last hello.
    pub const AMPLIFIER_FAULT: u8 = 1 << 2;
    /// Bit 3: the Qube detects a stall.
    pub const STALL_DETECTED: u8 = 1 << 3;
    /// Bit 4: the stall lasted and the Qube switched its motor off.
    pub const STALL_ERROR: u8 = 1 << 4;
    /// Bit 5: the emergency-stop switch is open, or was since the last hello that found it closed.
    pub const EMERGENCY_STOP: u8 = 1 << 5;
    /// Bit 6: the board knows of an emergency-stop switch.
    pub const STOP_SWITCH_FITTED: u8 = 1 << 6;
    /// Bits that are 0 in this version.
    pub const RESERVED: u8 = 1 << 7;

    /// Returns whether this flag is set; `bit` is one of the constants above.
    #[must_use]
    pub fn has(self, bit: u8) -> bool {
        self.0 & bit != 0
    }
}

macro_rules! wire_enum {
    ($(#[$meta:meta])* $name:ident { $($(#[$variant_meta:meta])* $variant:ident = $value:literal,)* }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(u8)]
        pub enum $name { $($(#[$variant_meta])* $variant = $value,)* }

        impl $name {
            /// All values, in the order of their numbers.
            pub const ALL: &[Self] = &[$(Self::$variant),*];

            /// The value with this number on the wire; `None` if no value has it.
            #[must_use]
            pub fn from_wire(value: u8) -> Option<Self> {
                match value { $($value => Some(Self::$variant),)* _ => None }
            }
        }
    };
}

wire_enum! {
    /// The kind of a device.
    DeviceKind {
        /// A program that behaves like a Qube.
        Emulator = 1,
        /// Arduino Uno, Nano.
        Atmega328p = 2,
        /// Arduino Mega.
        Atmega2560 = 3,
    }
}

wire_enum! {
    /// The state of a device; `PROTOCOL.md` has the table of transitions.
    DeviceState {
        /// The state after a start, after a hello of another protocol version, and after the Qube
        /// was switched off and on. The motor is off.
        Idle = 0,
        /// Greeted. The motor is off.
        Greeted = 1,
        /// Acts reach the motor.
        Armed = 2,
        /// The watchdog switched the motor off, until the next hello and `Arm` request.
        Tripped = 3,
        /// While the device was armed, the amplifier failed, the arm stalled, the Qube did not
        /// answer, or the emergency stop opened. The motor stays off until the next hello and `Arm`
        /// request.
        Faulted = 4,
    }
}

wire_enum! {
    /// The reason why a request was not carried out.
    RefusalReason {
        /// No hello came since the start of the device or its Qube, or the last one was of another
        /// protocol version.
        NotGreeted = 1,
        /// The device is not armed.
        NotArmed = 2,
        /// The watchdog has tripped: the host must send a hello and an `Arm` request first.
        WatchdogTripped = 3,
        /// A fault is latched or lasts: the host must send a hello and an `Arm` request once the
        /// cause is gone.
        Faulted = 4,
        /// The nonce is 0 or not the last one given, or an `Arm` request has used it.
        WrongNonce = 5,
        /// The device is armed already.
        AlreadyArmed = 6,
        /// The act is not newer than the last accepted act or `Arm` request.
        StaleSequence = 7,
        /// The voltage is above 5000 mV or below -5000 mV.
        VoltageOutOfRange = 8,
        /// The Qube does not answer the microcontroller, or has another module id.
        QubeAbsent = 9,
        /// The payload is longer or shorter than that of a request of this type.
        WrongLength = 10,
        /// No request has this type.
        UnknownType = 11,
        /// The act does not answer the last sample that was given, or that sample is too old.
        StaleSample = 12,
        /// The emergency-stop switch is open, or was since the last hello that found it closed.
        EmergencyStop = 13,
    }
}

impl RefusalReason {
    /// A short description for messages.
    #[must_use]
    pub fn describe(self) -> &'static str {
        match self {
            Self::NotGreeted => "it needs a hello first; start the command again",
            Self::NotArmed => "it is not armed",
            Self::WatchdogTripped => "its watchdog tripped; start the command again",
            Self::Faulted => {
                "a fault lasts or is latched; remove the cause, then start the command again"
            }
            Self::WrongNonce => "the nonce is used or wrong; start the command again",
            Self::AlreadyArmed => "it is armed already",
            Self::StaleSequence => "the command is not newer than the last",
            Self::VoltageOutOfRange => "the voltage is out of range",
            Self::QubeAbsent => "its Qube does not answer; check power and the SPI wires",
            Self::WrongLength => "it expects another length of this message",
            Self::UnknownType => "it does not know this message",
            Self::StaleSample => "the command does not answer a sample of the last 20 ms",
            Self::EmergencyStop => {
                "its emergency-stop switch is or was open; close it when nobody is near the arm"
            }
        }
    }
}

impl Reply {
    /// The reply's type on the wire.
    #[must_use]
    pub fn message_type(&self) -> u8 {
        match self {
            Self::Hello(_) => HELLO_REPLY,
            Self::Arm { .. } => ARM_REPLY,
            Self::Sample(_) => SAMPLE_REPLY,
            Self::Disarm(_) => DISARM_REPLY,
            Self::Refusal { .. } => REFUSAL,
        }
    }

    /// Encodes the reply to the request with this sequence number.
    #[must_use]
    pub fn encode(&self, sequence: u16) -> EncodedFrame {
        let mut payload = Writer::new();
        match self {
            Self::Hello(hello) => {
                payload.put(hello.protocol_version.to_le_bytes());
                payload.put(hello.firmware_version);
                payload.put([hello.kind]);
                payload.put(hello.module_id.to_le_bytes());
                payload.put(hello.serial);
                payload.put(hello.nonce.to_le_bytes());
                payload.put(hello.boot_id.to_le_bytes());
                payload.put(hello.dropped_frames.to_le_bytes());
            }
            Self::Arm { device_time_us } => payload.put(device_time_us.to_le_bytes()),
            Self::Sample(sample) => {
                payload.put(sample.device_time_us.to_le_bytes());
                payload.put(sample.theta_counts.to_le_bytes());
                payload.put(sample.alpha_counts.to_le_bytes());
                payload.put(sample.tachometer_counts_s.to_le_bytes());
                payload.put(sample.current_ma.to_le_bytes());
                payload.put([sample.status.0]);
                payload.put(sample.applied_mv.to_le_bytes());
                payload.put(sample.last_act_sequence.to_le_bytes());
                payload.put(sample.sample_to_act_us.to_le_bytes());
            }
            Self::Disarm(disarm) => {
                payload.put([disarm.state as u8]);
                payload.put(disarm.nonce.to_le_bytes());
                payload.put(disarm.dropped_frames.to_le_bytes());
            }
            Self::Refusal { refused_type, reason } => payload.put([*refused_type, *reason as u8]),
        }
        EncodedFrame::new(self.message_type(), sequence, payload.as_bytes())
    }

    /// Parses the reply in a frame.
    ///
    /// # Errors
    /// Fails on a type that no reply has, a payload of another length than the type's, or a number
    /// that stands for no state or reason.
    pub fn parse(frame: &Frame) -> Result<Self, ParseError> {
        let message_type = frame.message_type;
        let bad_field = ParseError::BadField(message_type);
        let length = match message_type {
            HELLO_REPLY => 24,
            ARM_REPLY => 4,
            SAMPLE_REPLY => 25,
            DISARM_REPLY => 7,
            REFUSAL => 2,
            other => return Err(ParseError::UnknownType(other)),
        };
        if frame.payload().len() != length {
            return Err(ParseError::WrongLength(message_type));
        }
        let mut fields = Reader::new(frame.payload());
        Ok(match message_type {
            HELLO_REPLY => Self::Hello(HelloReply {
                protocol_version: fields.u16(),
                firmware_version: fields.take(),
                kind: fields.u8(),
                module_id: fields.u16(),
                serial: fields.take(),
                nonce: fields.u32(),
                boot_id: fields.u16(),
                dropped_frames: fields.u16(),
            }),
            ARM_REPLY => Self::Arm { device_time_us: fields.u32() },
            SAMPLE_REPLY => Self::Sample(SampleReply {
                device_time_us: fields.u32(),
                theta_counts: fields.i32(),
                alpha_counts: fields.i32(),
                tachometer_counts_s: fields.i32(),
                current_ma: fields.i16(),
                status: StatusBits(fields.u8()),
                applied_mv: fields.i16(),
                last_act_sequence: fields.u16(),
                sample_to_act_us: fields.u16(),
            }),
            DISARM_REPLY => Self::Disarm(DisarmReply {
                state: DeviceState::from_wire(fields.u8()).ok_or(bad_field)?,
                nonce: fields.u32(),
                dropped_frames: fields.u16(),
            }),
            _ => Self::Refusal {
                refused_type: fields.u8(),
                reason: RefusalReason::from_wire(fields.u8()).ok_or(bad_field)?,
            },
        })
    }
}
