//! Input normalization that another operator than a convolution reads, as a 1×1 convolution per channel of the raw
//! image.

use super::lower_batch_norm::per_channel;
use crate::ir::{Conv2d, Graph, Op};

/// Runs after the convolutions took the normalization; one that nobody reads any more is dead code.
pub(super) fn run(graph: &mut Graph) {
    for node in &mut graph.nodes {
        if let Op::Normalize(normalization) = &node.op {
            let identity = per_channel(vec![1.0; normalization.mean.len()], None);
            node.op = Op::Conv2d(Conv2d { normalization: Some(normalization.clone()), ..identity });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Normalization;
    use crate::ir::verify::verify;
    use crate::passes::fixture::image;
    use crate::reference;
    use std::sync::Arc;

    #[test]
    fn pool_of_the_image_reads_a_convolution() {
        let (mut graph, rgb) = image();
        let normalization = Arc::new(Normalization { mean: vec![1.0, 2.0, 3.0], std: vec![0.5, 2.0, 4.0] });
        let x = graph.push("normalize", Op::Normalize(normalization), &[rgb]).unwrap();
        let y = graph.push("pool", Op::GlobalPool, &[x]).unwrap();
        graph.outputs.push(y);
        let input = vec![(0..48).map(|v| v as f32).collect()];
        let before = reference::run(&graph, &input, |_, _| ()).unwrap();
        run(&mut graph);
        assert_eq!(verify(&graph), Ok(()));
        assert!(matches!(&graph.producer(x).unwrap().op, Op::Conv2d(c) if c.normalization.is_some()));
        assert_eq!(reference::run(&graph, &input, |_, _| ()).unwrap(), before);
    }
}
