//! A page of two small grids.

use super::*;
use crate::attention::FrameAttention;
use crate::attention::block::{Grid, Grids};
use crate::attention::queries::QueryRows;
use crate::attention::statistics::{AgreementCounts, Counts, StrongestKeys};
use crate::report::html::attention_page;
use crate::report::html::tests::{HOSTILE, assert_well_formed, frame};
use crate::run::ModelInfo;

const GRIDS: Grids = Grids { image: Grid { rows: 2, columns: 2 }, lidar: Grid { rows: 2, columns: 3 } };

/// Two heads, three keys; asked are image tokens 0 and 1, and LiDAR tokens 5 and 8 (row 1 of 3).
pub(super) fn report() -> AttentionReport {
    let rows = QueryRows { image: None, lidar: Some(vec![1]) };
    let queries = Queries::new(&rows, GRIDS).unwrap();
    let keys = |keys: [[[u16; 3]; 4]; 2]| StrongestKeys {
        keys: keys.map(|head| head.map(|keys| keys.to_vec()).to_vec()).to_vec(),
        tied: 0,
    };
    let int8 = keys([[[0, 1, 2], [4, 5, 6], [0, 5, 6], [1, 2, 3]], [[0, 1, 4], [4, 5, 0], [0, 5, 6], [1, 2, 3]]]);
    let float = keys([[[0, 1, 3], [4, 5, 6], [0, 5, 6], [1, 2, 3]], [[0, 1, 3], [4, 5, 0], [0, 5, 6], [1, 2, 3]]]);
    let network = |keys: &StrongestKeys| {
        let mut counts = Counts::default();
        counts.add(keys, &queries);
        let model = ModelInfo { name: HOSTILE.into(), sha256: "ab".repeat(32) };
        Some(NetworkAttention { model, statistics: counts.figures() })
    };
    let agreement = Some(AgreementCounts::of(&int8, &float).figures());
    AttentionReport {
        schema: 1,
        block: HOSTILE.into(),
        heads: 2,
        top: 3,
        int8: network(&int8),
        float: network(&float),
        agreement,
        calibration_frames: vec![HOSTILE.into()],
        frames: vec![FrameAttention { name: HOSTILE.into(), int8: Some(int8), float: Some(float), agreement }],
        queries,
        gates: Vec::new(),
        failure: None,
    }
}

#[test]
fn the_page_is_whole_and_fetches_nothing() {
    let page = attention_page(&report(), &[frame()]);
    assert_well_formed(&page);
    assert!(!page.contains("alert('1')</script>"));
    assert!(!page.replace("data:image/png;base64,", "").contains("http"));
    for expected in ["<section id=\"statistics\"", "<section id=\"cells\"", "<section id=\"frames\"", "91.67 %"] {
        assert!(page.contains(expected), "{expected}");
    }
    assert_eq!(page.matches("<image ").count(), 2, "each picture once");
    assert_eq!((page.matches("<use ").count(), page.matches("query-keys shown").count()), (2, 2));
}

#[test]
fn one_network_alone_has_no_agreement() {
    let mut report = report();
    (report.int8, report.agreement) = (None, None);
    report.frames.iter_mut().for_each(|frame| (frame.int8, frame.agreement) = (None, None));
    let page = attention_page(&report, &[frame()]);
    assert_well_formed(&page);
    assert!(!page.contains("<section id=\"frames\"") && !page.contains("<use ") && !page.contains("agree"));
    assert_eq!(page.matches("<figure class=\"look\"").count(), 1);
}
