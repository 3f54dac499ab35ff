//! Tests that the policies in `policies/` balance and earn at least 90 % of the returns on their
//! page, in virtual time and guarded by the box alone.

use serde_json::Value;

use crate::program::program;

fn returns(policy: &str, qube: &[&str]) -> Vec<f64> {
    let directory = tempfile::tempdir().unwrap();
    let policy = format!("{}/policies/{policy}", env!("CARGO_MANIFEST_DIR"));
    let output = program(directory.path())
        .args(["run", "--policy", &policy, "--rollouts", "3"])
        .args(["--clock", "virtual", "--guard", "box", "--json"])
        .args(qube)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    let succeeded = |rollout: &Value| rollout.as_bool().unwrap();
    assert!(told["success"].as_array().unwrap().iter().all(succeeded), "{told}");
    told["returns"].as_array().unwrap().iter().map(|it| it.as_f64().unwrap()).collect()
}

/// The least returns lie 16 to 45 below the returns in `policies/README.md`. A step of 10 ms earns
/// at most 1, so these limits detect a policy that loses 0.16 to 0.45 s of its balance; smaller
/// losses pass.
#[test]
fn each_policy_balances_on_the_qubes_that_it_is_for() {
    for (policy, qube, at_least) in [
        ("nominal.safetensors", &[][..], 535.0),
        ("robust.safetensors", &[][..], 505.0),
        ("robust.safetensors", &["--profile", "lab"][..], 515.0),
        ("robust.safetensors", &["--profile", "lab", "--delay-ms", "16"][..], 500.0),
        ("robust.safetensors", &["--profile", "lab", "--gap", "1.5"][..], 495.0),
    ] {
        let returns = returns(policy, qube);
        assert!(returns.iter().all(|&it| it >= at_least), "{policy} on {qube:?}: {returns:?}");
    }
}
