//! The comparison can fail: an engine with a named fault is caught by `verify`, and by `attention` in its block.
//!
//! One test, for a fault is switched on for the whole process.

use model_compiler::import::System;
use tests::project::Project;

#[test]
fn commands_catch_an_engine_with_a_fault() {
    let project = Project::new(System::TransFuser);
    let command = "verify net.img --inputs inputs.safetensors";
    assert_eq!(project.host_sim(command).status, 0);
    let cases = [
        ("DepthTail", "conv2d"),
        ("TokenOrder", "tokens"),
        ("SoftmaxMaximum", "attention"),
        ("PoolSecondMap", "global_pool"),
        ("GateOrder", "waypoint_decoder"),
    ];
    for (fault, op) in cases {
        let outcome = project.host_sim(&format!("{command} --fault {fault}"));
        assert_eq!(outcome.status, 1, "{fault} was not caught");
        assert!(outcome.err.contains("the engine differs from the f64 model"), "{fault}: {}", outcome.err);
        let (_, report) = project.json(&format!("{command} --fault {fault} --json"));
        let position = report["first_difference"]["position"].as_u64().unwrap() as usize;
        assert_eq!(report["steps"][position]["op"], op, "{fault} shows first where it acts");
    }
    let attention = project.host_sim("attention net.img --inputs inputs.safetensors --fault SoftmaxMaximum");
    assert_eq!(attention.status, 1);
    assert!(
        attention.err.contains("the engine's context is not what queries, keys and values give"),
        "{}",
        attention.err
    );
    let vectors = project.host_sim(&format!("{command} --backend avx2 --fault DepthTail"));
    assert_eq!(vectors.status, 2);
    assert!(vectors.err.contains("--fault: the kernels of avx2 hold no faults"), "{}", vectors.err);
    let unknown = project.host_sim(&format!("{command} --fault Gremlins"));
    assert_eq!(unknown.status, 2);
    assert!(
        unknown.err.contains("no fault is called Gremlins") && unknown.err.contains("GateOrder"),
        "{}",
        unknown.err
    );
}
