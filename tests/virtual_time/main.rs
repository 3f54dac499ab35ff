//! Tests that compute: simulation and learning, in this process and in the program, with Qubes in
//! virtual time. No result depends on the speed or the load of the computer.

#[path = "../adversary/mod.rs"]
mod adversary;
mod commands_bad_arguments;
mod commands_bad_files;
mod commands_config;
mod commands_experiment;
mod commands_experiment_methods;
mod commands_hostile_surroundings;
mod commands_output;
mod commands_replay;
mod commands_soak;
mod commands_train;
mod control_bang_bang;
mod control_false_alarms;
mod control_frozen_arm;
mod control_homing;
mod control_late_computer;
mod control_motor_heat;
mod control_stale_samples;
mod control_virtual_time;
mod control_wrong_counts;
mod experiment_on_one_qube;
mod experiment_rivals;
mod experiments;
mod folders;
mod fuzz_corpus;
mod given_networks;
#[path = "../harmless/mod.rs"]
mod harmless;
mod identification_other_plant;
mod identification_real_qube;
mod identification_rig;
mod jobs_executors;
mod jobs_folder;
mod logged;
mod policy_shipped;
mod preflight_qube;
mod preflight_rigs;
mod program;
mod recording_table;
mod report_page;
mod rig_link_faults;
mod rig_measured;
mod rig_other_plant;
mod rig_switched_off;
mod rig_wrong_profile;
mod safety_adversary;
mod safety_by_type;
mod safety_limits;
mod safety_stranger;
mod session_ahead;
mod session_faults;
mod session_identified;
mod session_quietness;
mod session_recommendation;
mod session_resume;
mod session_rigs;
mod session_service;
#[path = "../shared/mod.rs"]
mod shared;
#[path = "../stranger/mod.rs"]
mod stranger;
mod surrogate_botorch;
mod watched_disarm;
