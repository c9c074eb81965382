//! Every backend of this machine writes the bytes of the portable one, operator by operator.

use firmware::conformance::{WORKSPACE_BYTES, check};
use host_sim::backends::BackendKind;

const SEEDS: [u64; 3] = [1, 0xC0FFEE, 0x5EED];

#[test]
fn every_backend_conforms() {
    let mut workspace = vec![0; WORKSPACE_BYTES];
    for kind in BackendKind::ALL {
        let Some(backend) = kind.detect() else {
            println!("{}: not run, this machine lacks the instructions", kind.name());
            continue;
        };
        for seed in SEEDS {
            let swept = check(backend.kernels(), seed, &mut workspace);
            let summary = swept.unwrap_or_else(|mismatch| panic!("{}: {mismatch}", kind.name()));
            println!("{}, seed {seed:#x}: {} steps, {} elements equal", kind.name(), summary.cases, summary.elements);
            assert_eq!(summary.left_out, 0, "the workspace holds every step");
        }
    }
}
