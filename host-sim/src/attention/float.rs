//! The softmax rows of the f32 network.

use super::AttentionMap;
use super::block::FloatBlock;
use model_compiler::error::Result;
use model_compiler::frames::Frame;
use model_compiler::reference::{self, attention_weights};

/// A graph that shows one of its attention blocks.
#[derive(Clone, Debug)]
pub struct FloatAttention<'a> {
    block: FloatBlock<'a>,
}

impl<'a> FloatAttention<'a> {
    /// Shows a block.
    pub fn new(block: FloatBlock<'a>) -> Self {
        Self { block }
    }

    /// The rows of a frame.
    ///
    /// # Errors
    /// The frame lacks an input.
    pub fn map(&self, frame: &Frame) -> Result<AttentionMap> {
        let FloatBlock { block, graph, node } = &self.block;
        let inputs: Vec<Vec<f32>> = graph.inputs().map(|(_, kind)| frame.raw(kind)).collect::<Result<_>>()?;
        let (mut query, mut key) = (Vec::new(), Vec::new());
        reference::run(graph, &inputs, |ran, values| {
            if ran.output == node.inputs[0] {
                query = values.to_vec();
            }
            if ran.output == node.inputs[1] {
                key = values.to_vec();
            }
        })?;
        let shape = graph.value(node.output).shape;
        let weights = attention_weights(block.heads, shape, &query, &key);
        Ok(AttentionMap { tokens: shape.positions() as usize, heads: block.heads.into(), weights })
    }
}
