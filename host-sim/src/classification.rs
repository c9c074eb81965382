//! What a classifier says: the class of a frame, how often it is right, how often two networks say the same.

use crate::statistics::ErrorSums;
use model_compiler::frames::Frame;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::cmp::Ordering;

/// How many of the most likely classes are looked at beside the first, where there are more classes than that.
const SHORTLIST: usize = 5;

/// What a network says about one frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Classification {
    /// The network's first output, real values: one per class.
    pub logits: Vec<f64>,
    /// The class with the largest logit; of equal ones the first.
    pub top1: usize,
    /// The five classes with the largest logits, largest first, where there are more than five.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub top5: Option<Vec<usize>>,
    /// The class that the frame is labeled with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub label: Option<usize>,
}

impl Classification {
    /// Reads a network's output.
    pub fn new(logits: Vec<f64>, frame: &Frame) -> Self {
        let largest_first = |&a: &usize, &b: &usize| match logits[b].partial_cmp(&logits[a]) {
            // What is not a number is no class.
            None => logits[a].is_nan().cmp(&logits[b].is_nan()),
            Some(Ordering::Equal) => a.cmp(&b),
            Some(order) => order,
        };
        let mut classes: Vec<usize> = (0..logits.len()).collect();
        classes.sort_by(largest_first);
        let top1 = classes.first().copied().unwrap_or(0);
        let top5 = (classes.len() > SHORTLIST).then(|| classes[..SHORTLIST].to_vec());
        let label = frame.label.as_ref().map(|label| usize::from(label.class));
        Self { logits, top1, top5, label }
    }

    /// Whether the class is the label; `None` without one.
    pub fn is_right(&self) -> Option<bool> {
        self.label.map(|label| label == self.top1)
    }

    fn shortlists_label(&self) -> Option<bool> {
        Some(self.top5.as_ref()?.contains(&self.label?))
    }
}

/// A share of frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Share {
    hits: usize,
    frames: usize,
}

impl Share {
    fn add(&mut self, hit: bool) {
        self.hits += usize::from(hit);
        self.frames += 1;
    }

    /// From 0 to 1; 0 of no frames.
    fn value(self) -> f64 {
        self.hits as f64 / self.frames.max(1) as f64
    }

    /// 95 % interval of Wilson's score: the shares of a large population that would not make this sample a surprise.
    fn interval(self) -> [f64; 2] {
        /// Quantile 0.975 of the normal distribution.
        const Z: f64 = 1.959_963_984_540_054;
        if self.frames == 0 {
            return [0.0, 1.0];
        }
        let (p, n) = (self.value(), self.frames as f64);
        let center = p + Z * Z / (2.0 * n);
        let reach = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
        let scale = 1.0 + Z * Z / n;
        [((center - reach) / scale).max(0.0), ((center + reach) / scale).min(1.0)]
    }
}

/// How often a network is right.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Accuracy {
    /// Share of the labeled frames whose label is the first class.
    pub top1: f64,
    /// 95 % interval of that share (Wilson).
    pub interval: [f64; 2],
    /// Share of the labeled frames whose label is among the five first classes, where there are more than five.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub top5: Option<f64>,
    /// Labeled frames.
    pub frames: usize,
}

impl Accuracy {
    /// Over the labeled ones of these frames; `None` where there is none.
    pub fn of<'a>(frames: impl IntoIterator<Item = &'a Classification>) -> Option<Self> {
        let (mut top1, mut top5) = (Share::default(), Share::default());
        for frame in frames {
            frame.is_right().into_iter().for_each(|hit| top1.add(hit));
            frame.shortlists_label().into_iter().for_each(|hit| top5.add(hit));
        }
        let top5_share = (top5.frames > 0).then(|| top5.value());
        let accuracy = Self { top1: top1.value(), interval: top1.interval(), top5: top5_share, frames: top1.frames };
        (accuracy.frames > 0).then_some(accuracy)
    }
}

/// How often two networks give the same class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Agreement {
    /// Share of the frames.
    pub share: f64,
    /// 95 % interval of that share (Wilson).
    pub interval: [f64; 2],
    /// Frames.
    pub frames: usize,
}

/// A frame as the engine and the f32 network see it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ClassifiedFrame {
    /// Of the engine.
    #[serde(flatten)]
    pub int8: Classification,
    /// Logits of the f32 network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_logits: Option<Vec<f64>>,
    /// Class of the f32 network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_top1: Option<usize>,
}

/// The engine's classifier beside the f32 network; without the latter only [`Self::int8`] is known.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ClassificationSummary {
    /// Of the engine; `None` without labels.
    pub int8: Option<Accuracy>,
    /// Of the f32 network.
    #[serde(rename = "f32")]
    pub float: Option<Accuracy>,
    /// Frames where both give the same class.
    pub agreement: Option<Agreement>,
    /// Labeled frames where only the engine is right.
    pub only_int8_right: Option<usize>,
    /// Labeled frames where only the f32 network is right.
    pub only_f32_right: Option<usize>,
    /// SQNR of the logits over all frames, dB.
    pub logits_sqnr_db: Option<f64>,
}

/// Sums up frame by frame.
#[derive(Clone, Debug, Default)]
pub struct Comparison {
    int8: Vec<Classification>,
    float: Vec<Classification>,
    logits: ErrorSums,
}

impl Comparison {
    /// Adds the first output of the engine and, where there is one, of the f32 network.
    pub fn add(&mut self, frame: &Frame, found: &[f32], reference: Option<&[f32]>) -> ClassifiedFrame {
        let read = |output: &[f32]| Classification::new(output.iter().copied().map(f64::from).collect(), frame);
        let int8 = read(found);
        self.int8.push(int8.clone());
        let float = reference.map(|reference| {
            self.logits.add(reference, found);
            self.float.push(read(reference));
            read(reference)
        });
        let (reference_logits, reference_top1) = float.map(|f| (f.logits, f.top1)).unzip();
        ClassifiedFrame { int8, reference_logits, reference_top1 }
    }

    /// The figures of all frames; `None` where there was none.
    pub fn summary(&self) -> Option<ClassificationSummary> {
        if self.int8.is_empty() {
            return None;
        }
        let int8 = Accuracy::of(&self.int8);
        if self.float.is_empty() {
            return Some(ClassificationSummary { int8, ..ClassificationSummary::default() });
        }
        let pairs = || self.int8.iter().zip(&self.float);
        let mut agreement = Share::default();
        pairs().for_each(|(i, f)| agreement.add(i.top1 == f.top1));
        let only = |int8_right: bool| {
            let right = Some(int8_right);
            pairs().filter(|(i, f)| i.is_right() == right && f.is_right() == Some(!int8_right)).count()
        };
        let is_labeled = int8.is_some();
        Some(ClassificationSummary {
            int8,
            float: Accuracy::of(&self.float),
            agreement: Some(Agreement {
                share: agreement.value(),
                interval: agreement.interval(),
                frames: agreement.frames,
            }),
            only_int8_right: is_labeled.then(|| only(true)),
            only_f32_right: is_labeled.then(|| only(false)),
            logits_sqnr_db: Some(self.logits.sqnr_db()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use model_compiler::frames::Label;

    fn frame(label: Option<u16>) -> Frame {
        let label = label.map(|class| Label { class, name: String::new() });
        Frame { name: "a".into(), label, ..Frame::default() }
    }

    #[test]
    fn classes_are_ranked_and_equal_ones_keep_their_order() {
        let ranked = Classification::new(vec![1.0, 3.0, -2.0, 3.0, 0.0, 2.0], &frame(Some(4)));
        assert_eq!((ranked.top1, ranked.top5.as_deref()), (1, Some(&[1, 3, 5, 0, 4][..])));
        assert_eq!((ranked.is_right(), ranked.shortlists_label()), (Some(false), Some(true)));
        let five = Classification::new(vec![1.0, 3.0, 2.0, 0.0, -1.0], &frame(None));
        assert_eq!((five.top1, five.top5, five.label), (1, None, None));
        let broken = Classification::new(vec![f64::NAN, -1.0, f64::NAN], &frame(None));
        assert_eq!(broken.top1, 1);
    }

    /// Values of the formula in Wilson 1927, as statsmodels' `proportion_confint(method="wilson")` prints them.
    #[test]
    fn the_interval_is_wilsons() {
        let close = |share: Share, expected: [f64; 2]| {
            let found = share.interval();
            assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 5e-5), "{found:?} {expected:?}");
        };
        close(Share { hits: 455, frames: 500 }, [0.8817, 0.9321]);
        close(Share { hits: 10, frames: 10 }, [0.7225, 1.0]);
        close(Share { hits: 0, frames: 10 }, [0.0, 0.2775]);
        close(Share::default(), [0.0, 1.0]);
    }

    #[test]
    fn accuracy_counts_labeled_frames_only() {
        let say = |logits: &[f64], label| Classification::new(logits.to_vec(), &frame(label));
        let frames = [say(&[1.0, 0.0], Some(0)), say(&[1.0, 0.0], Some(1)), say(&[1.0, 0.0], None)];
        let accuracy = Accuracy::of(&frames).unwrap();
        assert_eq!((accuracy.top1, accuracy.frames, accuracy.top5), (0.5, 2, None));
        assert_eq!(Accuracy::of(&frames[2..]), None);
        let many = say(&[6.0, 5.0, 4.0, 3.0, 2.0, 1.0], Some(4));
        assert_eq!(Accuracy::of([&many]).unwrap().top5, Some(1.0));
    }

    fn compared() -> ClassificationSummary {
        let mut comparison = Comparison::default();
        comparison.add(&frame(Some(0)), &[3.0, 4.5], Some(&[4.0, 3.0]));
        comparison.add(&frame(Some(0)), &[3.0, 1.0], Some(&[3.0, 1.0]));
        comparison.add(&frame(Some(0)), &[3.0, 1.0], Some(&[1.0, 3.0]));
        comparison.add(&frame(Some(0)), &[3.0, 1.0], Some(&[1.0, 3.0]));
        comparison.summary().unwrap()
    }

    #[test]
    fn both_networks_are_compared_frame_by_frame() {
        let found = compared();
        assert_eq!((found.only_int8_right, found.only_f32_right), (Some(2), Some(1)));
        assert_eq!((found.int8.as_ref().unwrap().top1, found.float.as_ref().unwrap().top1), (0.75, 0.5));
        assert_eq!(found.agreement.as_ref().unwrap().share, 0.25);
        // Signal 25 + 10 + 10 + 10, noise 3.25 + 8 + 8.
        assert!((found.logits_sqnr_db.unwrap() - 10.0 * (55.0_f64 / 19.25).log10()).abs() < 1e-12);
        assert_eq!(Comparison::default().summary(), None);
        let mut alone = Comparison::default();
        let seen = alone.add(&frame(None), &[1.0, 2.0], None);
        assert_eq!((seen.int8.top1, seen.reference_logits), (1, None));
        assert_eq!(alone.summary(), Some(ClassificationSummary::default()));
    }
}
