//! Input normalization into the convolutions that read it: they take raw input, and their padding stands for the mean.

use crate::ir::{Graph, Op};
use std::collections::HashMap;

/// The normalization itself stays for other readers; without any it is dead code.
pub(super) fn run(graph: &mut Graph) {
    let mut normalized = HashMap::new();
    for node in &mut graph.nodes {
        match &mut node.op {
            Op::Normalize(normalization) => {
                normalized.insert(node.output, (node.inputs[0], normalization.clone()));
            }
            Op::Conv2d(conv) if conv.normalization.is_none() => {
                if let Some((raw, normalization)) = normalized.get(&node.inputs[0]) {
                    conv.normalization = Some(normalization.clone());
                    node.inputs[0] = *raw;
                }
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Normalization;
    use crate::passes::fixture::{conv, image};
    use std::sync::Arc;

    #[test]
    fn convolution_reads_raw_input() {
        let (mut graph, rgb) = image();
        let normalization = Arc::new(Normalization { mean: vec![0.5; 3], std: vec![0.25; 3] });
        let x = graph.push("normalize", Op::Normalize(normalization.clone()), &[rgb]).unwrap();
        let y = conv(&mut graph, "conv", x, 4);
        let z = conv(&mut graph, "next", y, 4);
        graph.outputs.push(z);
        run(&mut graph);
        let folded = graph.producer(y).unwrap();
        assert_eq!(folded.inputs, [rgb]);
        assert!(matches!(&folded.op, Op::Conv2d(c) if c.normalization.as_ref() == Some(&normalization)));
        assert!(matches!(&graph.producer(z).unwrap().op, Op::Conv2d(c) if c.normalization.is_none()));
    }
}
