//! Time of a whole rollout in virtual time, with the emulated Qube behind the in-process wire:
//! settling, 6 s of policy, braking.
//!
//! The rollout takes more than 6 s in real time, so a result of 30 ms is 200 times faster than real
//! time.

use std::sync::atomic::AtomicBool;

use criterion::{Criterion, criterion_group, criterion_main};
use qube_hil::clock::VirtualClock;
use qube_hil::control::{Homing, HomingSettings, RING_CAPACITY, Tick, drive};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, SerialLink};
use qube_hil::estimation::EstimatorSettings;
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::safety::{MotorHeat, SafetyBox};
use qube_hil::telemetry::TickSettings;

fn virtual_rollout(criterion: &mut Criterion) {
    let clock = VirtualClock::default();
    let mut device = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
    device.hello().expect("an emulated Qube answers");
    let stop = AtomicBool::new(false);
    let mut homing = Homing::new(&HomingSettings::default());
    drive(&mut device, &clock, &mut homing, &mut MotorHeat::default(), None, &stop)
        .expect("the Qube is homed");
    let settings = TickSettings {
        calibration: homing.measured().expect("homing has found the middle").calibration,
        estimator: EstimatorSettings::default(),
        safety_box: SafetyBox::THESIS,
        max_steps: 600,
        start_theta_rad: 0.0,
        stops: None,
        foresight: None,
        rules: qube_hil::telemetry::TickRules::NEWEST,
        plant: qube_hil::qube::PlantModel::QUBE,
    };
    let network = Policy::load(std::path::Path::new("policies/nominal.safetensors"));
    let classical = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    for (name, policy) in
        [("classical", classical), ("network", network.expect("the policy can be read"))]
    {
        criterion.bench_function(&format!("virtual rollout, {name}"), |bencher| {
            bencher.iter(|| {
                let (mut producer, _consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
                let mut tick = Tick::new(&settings, policy.clone());
                drive(
                    &mut device,
                    &clock,
                    &mut tick,
                    &mut MotorHeat::default(),
                    Some(&mut producer),
                    &stop,
                )
                .expect("the rollout ends without a fault")
            });
        });
    }
}

criterion_group!(benches, virtual_rollout);
criterion_main!(benches);
