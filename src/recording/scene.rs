use super::protobuf::Message;
use crate::qube::{PlantModel, State};

// This file makes the data for the 3-D panels of Foxglove, Lichtblick and Rerun, as Protocol
// Buffers by Foxglove's published schemas: for each tick the poses of the frames, and once a
// rollout the bodies that are fixed to the frames.
//
// There are three frames. `qube` is fixed to the table, with z up and x along the arm at theta = 0.
// `arm` turns by theta about z. `pendulum` is at the arm's tip and turns by alpha about the arm's
// axis x; its z points from the pendulum's free end to the arm's tip, so at alpha = 0 the pendulum
// hangs, and positive alpha swings it in the direction of positive theta.

/// A schema of Foxglove as recordings contain it: its name and its serialised `FileDescriptorSet`.
/// The files come from the package `foxglove` 0.30.3 (MIT, `foxglove/LICENSE`).
pub(super) struct Schema {
    pub(super) name: &'static str,
    pub(super) descriptors: &'static [u8],
}

const BASE: &str = "qube";
const ARM: &str = "arm";
const PENDULUM: &str = "pendulum";

/// Height of the arm above the table, m; only the picture uses it.
const ARM_HEIGHT_M: f64 = 0.2;

/// A position or a size, m.
#[derive(Clone, Copy)]
struct Vector3 {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Clone, Copy)]
struct Quaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

struct FrameTransform {
    parent_frame_id: &'static str,
    child_frame_id: &'static str,
    translation: Vector3,
    rotation: Quaternion,
}

/// The poses of arm and pendulum at one time, ns since 1970.
pub(super) struct FrameTransforms {
    time_ns: u64,
    transforms: [FrameTransform; 2],
}

struct Color {
    r: f64,
    g: f64,
    b: f64,
    a: f64,
}

struct Cube {
    center: Vector3,
    size: Vector3,
    color: Color,
}

/// A body with the name of the frame that it is fixed to.
struct Entity {
    frame_id: &'static str,
    cube: Cube,
}

/// The bodies that are fixed to the frames: base, arm, pendulum.
pub(super) struct SceneUpdate {
    time_ns: u64,
    entities: [Entity; 3],
}

/// The rotation by 0 rad.
const IDENTITY: Quaternion = Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 };

fn time(time_ns: u64) -> Message {
    Message::default().integer(1, time_ns / 1_000_000_000).integer(2, time_ns % 1_000_000_000)
}

impl Vector3 {
    fn message(self) -> Message {
        Message::default().double(1, self.x).double(2, self.y).double(3, self.z)
    }
}

impl Quaternion {
    fn message(self) -> Message {
        Message::default().double(1, self.x).double(2, self.y).double(3, self.z).double(4, self.w)
    }
}

impl FrameTransforms {
    pub(super) const SCHEMA: Schema = Schema {
        name: "foxglove.FrameTransforms",
        descriptors: include_bytes!("foxglove/FrameTransforms.bin"),
    };

    /// The frames of a plant in one state at `time_ns`. An angle that is not finite is drawn as
    /// zero.
    pub(super) fn new(plant: &PlantModel, state: &State, time_ns: u64) -> Self {
        let half = |angle: f64| if angle.is_finite() { 0.5 * angle } else { 0.0 };
        let (half_theta, half_alpha) = (half(state.theta), half(state.alpha));
        let arm_length_m = plant.parameters.rotary_length_m;
        Self {
            time_ns,
            transforms: [
                FrameTransform {
                    parent_frame_id: BASE,
                    child_frame_id: ARM,
                    translation: Vector3 { x: 0.0, y: 0.0, z: ARM_HEIGHT_M },
                    rotation: Quaternion {
                        z: libm::sin(half_theta),
                        w: libm::cos(half_theta),
                        ..IDENTITY
                    },
                },
                FrameTransform {
                    parent_frame_id: ARM,
                    child_frame_id: PENDULUM,
                    translation: Vector3 { x: arm_length_m, y: 0.0, z: 0.0 },
                    rotation: Quaternion {
                        x: libm::sin(half_alpha),
                        w: libm::cos(half_alpha),
                        ..IDENTITY
                    },
                },
            ],
        }
    }

    /// The bytes of the message `foxglove.FrameTransforms`.
    pub(super) fn to_bytes(&self) -> Vec<u8> {
        let transform = |it: &FrameTransform| {
            Message::default()
                .message(1, &time(self.time_ns))
                .text(2, it.parent_frame_id)
                .text(3, it.child_frame_id)
                .message(4, &it.translation.message())
                .message(5, &it.rotation.message())
        };
        let add = |whole: Message, it| whole.message(1, &transform(it));
        self.transforms.iter().fold(Message::default(), add).into_bytes()
    }
}

impl SceneUpdate {
    pub(super) const SCHEMA: Schema = Schema {
        name: "foxglove.SceneUpdate",
        descriptors: include_bytes!("foxglove/SceneUpdate.bin"),
    };

    /// The bodies of a plant: boxes with the plant's nominal lengths.
    pub(super) fn new(plant: &PlantModel, time_ns: u64) -> Self {
        let nominal = &plant.parameters;
        let (arm, pendulum) = (nominal.rotary_length_m, nominal.pendulum_length_m);
        let entity =
            |frame_id, center, size, color| Entity { frame_id, cube: Cube { center, size, color } };
        let gray = Color { r: 0.3, g: 0.3, b: 0.32, a: 1.0 };
        let silver = Color { r: 0.75, g: 0.75, b: 0.78, a: 1.0 };
        let red = Color { r: 0.8, g: 0.1, b: 0.1, a: 1.0 };
        let body_m = ARM_HEIGHT_M - 0.01;
        Self {
            time_ns,
            entities: [
                entity(
                    BASE,
                    Vector3 { x: 0.0, y: 0.0, z: 0.5 * body_m },
                    Vector3 { x: 0.1, y: 0.1, z: body_m },
                    gray,
                ),
                entity(
                    ARM,
                    Vector3 { x: 0.5 * arm, y: 0.0, z: 0.0 },
                    Vector3 { x: arm, y: 0.01, z: 0.01 },
                    silver,
                ),
                entity(
                    PENDULUM,
                    Vector3 { x: 0.005, y: 0.0, z: -0.5 * pendulum },
                    Vector3 { x: 0.008, y: 0.008, z: pendulum },
                    red,
                ),
            ],
        }
    }
    /// The bytes of the message `foxglove.SceneUpdate`. It deletes no earlier body, and its bodies
    /// never expire.
    pub(super) fn to_bytes(&self) -> Vec<u8> {
        let entity = |Entity { frame_id, cube }: &Entity| {
            let pose = Message::default()
                .message(1, &cube.center.message())
                .message(2, &IDENTITY.message());
            let Color { r, g, b, a } = cube.color;
            let color = Message::default().double(1, r).double(2, g).double(3, b).double(4, a);
            let cube = Message::default()
                .message(1, &pose)
                .message(2, &cube.size.message())
                .message(3, &color);
            Message::default()
                .message(1, &time(self.time_ns))
                .text(2, frame_id)
                .text(3, frame_id)
                .message(4, &Message::default())
                .flag(5, true)
                .message(8, &cube)
        };
        let add = |whole: Message, it| whole.message(2, &entity(it));
        self.entities.iter().fold(Message::default(), add).into_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::DomainParameters;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn rotate(q: Quaternion, v: [f64; 3]) -> [f64; 3] {
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let axis = [q.x, q.y, q.z];
        let t = cross(axis, v).map(|x| 2.0 * x);
        let u = cross(axis, t);
        [v[0] + q.w * t[0] + u[0], v[1] + q.w * t[1] + u[1], v[2] + q.w * t[2] + u[2]]
    }

    /// Position of the pendulum's free end in the base frame, m.
    fn tip(theta: f64, alpha: f64) -> [f64; 3] {
        let state = State { theta, alpha, ..State::default() };
        let [arm, pendulum] = FrameTransforms::new(&PlantModel::QUBE, &state, 0).transforms;
        let length = DomainParameters::NOMINAL.pendulum_length_m;
        let in_arm = rotate(pendulum.rotation, [0.0, 0.0, -length]);
        let in_arm = [in_arm[0] + pendulum.translation.x, in_arm[1], in_arm[2]];
        let in_base = rotate(arm.rotation, in_arm);
        [in_base[0], in_base[1], in_base[2] + arm.translation.z]
    }

    #[test]
    fn the_tip_is_where_the_angles_say() {
        let (arm, length) = (
            DomainParameters::NOMINAL.rotary_length_m,
            DomainParameters::NOMINAL.pendulum_length_m,
        );
        for (theta, alpha, expected) in [
            (0.0, 0.0, [arm, 0.0, ARM_HEIGHT_M - length]),
            (0.0, PI, [arm, 0.0, ARM_HEIGHT_M + length]),
            (0.0, FRAC_PI_2, [arm, length, ARM_HEIGHT_M]),
            (FRAC_PI_2, 0.0, [0.0, arm, ARM_HEIGHT_M - length]),
            (FRAC_PI_2, FRAC_PI_2, [-length, arm, ARM_HEIGHT_M]),
        ] {
            for (found, expected) in tip(theta, alpha).into_iter().zip(expected) {
                assert!((found - expected).abs() < 1e-15, "{theta} {alpha}: {found} {expected}");
            }
        }
    }

    /// Rerun draws no shapes from the channel `/scene`. It takes them from this URDF file, and
    /// moves them by the channel `/tf`.
    #[test]
    fn the_bodies_for_rerun_are_those_of_the_scene() {
        let file = include_str!("../../scripts/qube.urdf");
        let scene = SceneUpdate::new(&PlantModel::QUBE, 0);
        let round = |value: f64| (value * 1e6).round() / 1e6;
        let three =
            |Vector3 { x, y, z }: &Vector3| format!("{} {} {}", round(*x), round(*y), round(*z));
        for Entity { frame_id, cube: Cube { center, size, color } } in &scene.entities {
            let begin = file.find(&format!("<link name=\"{frame_id}\">")).unwrap();
            let link = file[begin..].split("</link>").next().unwrap();
            let Color { r, g, b, a } = color;
            for text in [
                format!("<origin xyz=\"{}\"/>", three(center)),
                format!("<box size=\"{}\"/>", three(size)),
                format!("<color rgba=\"{r} {g} {b} {a}\"/>"),
            ] {
                assert!(link.contains(&text), "{text}: {link}");
            }
        }
        let frames = FrameTransforms::new(&PlantModel::QUBE, &State::default(), 0);
        for FrameTransform { parent_frame_id, child_frame_id, translation, .. } in frames.transforms
        {
            let parent = format!("<parent link=\"{parent_frame_id}\"/>");
            let joint = file.split("</joint>").find(|joint| joint.contains(&parent)).unwrap();
            let child = format!("<child link=\"{child_frame_id}\"/>");
            let origin = format!("<origin xyz=\"{}\"/>", three(&translation));
            assert!(joint.contains(&child) && joint.contains(&origin), "{origin}: {joint}");
        }
    }
}
