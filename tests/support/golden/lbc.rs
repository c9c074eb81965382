//! LBC: its stored inputs, and checkpoints of any size.

use super::VIEWS;
use super::network::{List, plausible};
use model_compiler::import::NamedTensors;

/// Map `i` of the stored views `[N][9][H][W]`, and the heatmap that the original network saw beside it: `exp(−d²/50)`
/// in a square of 11 pixels around column 40 + 50·i, row 120 − 20·i. `[H][W][10]`, grey levels.
pub(super) fn views(stored: &[u8], i: usize) -> Vec<f32> {
    let [height, width] = VIEWS;
    let planes = &stored[i * 9 * height * width..][..9 * height * width];
    let center = [40 + 50 * i as i32, 120 - 20 * i as i32];
    let heat = |pixel: usize| {
        let [dx, dy] = [(pixel % width) as i32 - center[0], (pixel / width) as i32 - center[1]];
        let inside = dx.abs().max(dy.abs()) <= 5;
        if inside { (-f64::from(dx * dx + dy * dy) / 50.0).exp() as f32 * 255.0 } else { 0.0 }
    };
    let pixel = |p: usize| (0..9).map(move |c| f32::from(planes[c * height * width + p])).chain([heat(p)]);
    (0..height * width).flat_map(pixel).collect()
}

/// Sizes of a network; the published ones, or small ones for fast tests.
#[derive(Clone, Debug)]
pub struct Lbc {
    /// Channels of the stem.
    pub stem: usize,
    /// Channels inside the blocks, per stage.
    pub widths: [usize; 4],
    /// Channels between the blocks, per stage.
    pub outputs: [usize; 4],
    /// Blocks per stage.
    pub blocks: [usize; 4],
    /// Channels of the head.
    pub head: usize,
    /// Maps of logits.
    pub maps: usize,
    /// Height and width of the input, pixels.
    pub resolution: (u16, u16),
}

impl Lbc {
    /// The network as published.
    pub fn published() -> Self {
        Self {
            stem: 64,
            widths: [64, 128, 256, 512],
            outputs: [256, 512, 1024, 2048],
            blocks: [3, 4, 6, 3],
            head: 256,
            maps: 4,
            resolution: (144, 256),
        }
    }

    /// One or two blocks per stage, few channels, and an input of 48×64.
    pub fn small() -> Self {
        Self {
            stem: 8,
            widths: [4, 6, 8, 8],
            outputs: [12, 16, 16, 20],
            blocks: [1, 2, 2, 2],
            head: 10,
            maps: 3,
            resolution: (48, 64),
        }
    }

    /// Names and shapes of the checkpoint.
    pub fn shapes(&self) -> Vec<(String, Vec<usize>)> {
        let mut list = List::default();
        list.batch_norm("net.norm", 10);
        self.backbone(&mut list);
        let (classifier, input) = ("net.network.classifier", self.outputs[3]);
        for (branch, kernel) in [1, 3, 3, 3].into_iter().enumerate() {
            list.conv_norm(&format!("{classifier}.0.convs.{branch}"), 0, [self.head, input, kernel, kernel]);
        }
        list.conv_norm(&format!("{classifier}.0.convs.4"), 1, [self.head, input, 1, 1]);
        list.conv_norm(&format!("{classifier}.0.project"), 0, [self.head, 5 * self.head, 1, 1]);
        list.conv_norm(classifier, 1, [self.head, self.head, 3, 3]);
        list.add(format!("{classifier}.4.weight"), &[self.maps, self.head, 1, 1]);
        list.add(format!("{classifier}.4.bias"), &[self.maps]);
        list.0
    }

    fn backbone(&self, list: &mut List) {
        let prefix = "net.network.backbone";
        list.add(format!("{prefix}.conv1.weight"), &[self.stem, 10, 7, 7]);
        list.batch_norm(&format!("{prefix}.bn1"), self.stem);
        let mut input = self.stem;
        for (stage, count) in self.blocks.into_iter().enumerate() {
            let (width, output) = (self.widths[stage], self.outputs[stage]);
            for block in 0..count {
                let module = format!("{prefix}.layer{}.{block}", stage + 1);
                let mut layer = |k: usize, shape: [usize; 4]| {
                    list.add(format!("{module}.conv{k}.weight"), &shape);
                    list.batch_norm(&format!("{module}.bn{k}"), shape[0]);
                };
                layer(1, [width, input, 1, 1]);
                layer(2, [width, width, 3, 3]);
                layer(3, [output, width, 1, 1]);
                if block == 0 && (stage == 1 || input != output) {
                    list.conv_norm(&format!("{module}.downsample"), 0, [output, input, 1, 1]);
                }
                input = output;
            }
        }
    }

    /// Generated values with plausible batch-norm statistics: activations stay of order 1 on real frames.
    pub fn tensors(&self) -> NamedTensors {
        plausible(&self.shapes(), |norm| if norm == "net.norm" { 0.1 } else { 1.5 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden;
    use model_compiler::import::System;

    #[test]
    fn the_published_network_has_the_published_names_and_shapes() {
        let mut shapes = Lbc::published().shapes();
        shapes.sort();
        assert_eq!(shapes, golden::shapes(System::Lbc));
    }

    /// The stored bytes and the rule of the heatmap are the network's own input, where that is there.
    #[test]
    fn stored_views_are_those_that_the_original_network_saw() {
        let Some(path) = crate::commands::shared("golden/inputs.safetensors") else { return };
        let file = std::fs::read(path).unwrap();
        let file = safetensors::SafeTensors::deserialize(&file).unwrap();
        let planes = file.tensor("lbc_input").unwrap();
        let planes: Vec<f32> = planes.data().as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect();
        let plane = VIEWS[0] * VIEWS[1];
        for (frame, planes) in golden::frames().iter().zip(planes.chunks_exact(10 * plane)) {
            for (element, level) in frame.views.iter().enumerate() {
                assert_eq!(*level, planes[element % 10 * plane + element / 10] * 255.0, "element {element}");
            }
        }
    }
}
