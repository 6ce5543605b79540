//! The U-Net of Open Image Denoise (`demc_model::unet`) as a graph.

use demc_data::Normalizer;
use demc_model::config::COLOR_CHANNELS;
use demc_model::unet::{Unet, UnetLevel};

use super::graph::{AttributeValue, GraphBuilder, Value};

impl GraphBuilder {
    pub(super) fn unet(&mut self, network: &Unet, normalizer: &Normalizer) {
        let mut inputs = vec![self.compressed(normalizer, None)];
        let guides = network.guides().first_channels();
        if !guides.is_empty() {
            let clamped = self.clamped_features(normalizer);
            let features = self.features_z(normalizer, &clamped);
            for first in guides {
                let channels = *first..first + COLOR_CHANNELS;
                inputs.push(self.channels(&format!("guide.{first}"), &features, channels));
            }
        }
        let inputs: Vec<&Value> = inputs.iter().collect();
        let mut x = self.concat("inputs", &inputs);
        let mut skips = Vec::new();
        for level in &network.encoder {
            skips.push(x.clone());
            let y = self.unet_level(&x, level);
            x = self.pooled(&y);
        }
        x = self.unet_level(&x, &network.bottom);
        for level in &network.decoder {
            let skip = skips.pop().expect("a skip for each level");
            let both = self.doubled_with(&x, &skip);
            x = self.unet_level(&both, level);
        }
        let y = self.conv(&x, &network.head, None);
        let out = self.relu(&y);
        self.expanded(normalizer, &out);
    }

    fn unet_level(&mut self, x: &Value, level: &UnetLevel) -> Value {
        level.convs.iter().fold(x.clone(), |x, conv| {
            let y = self.conv(&x, conv, None);
            self.relu(&y)
        })
    }

    /// The map, doubled by repeating pixels, and the channels of `skip`.
    fn doubled_with(&mut self, x: &Value, skip: &Value) -> Value {
        let name = |what: &str| format!("{}.{what}", x.0);
        let scales = self.constant(&name("scales"), &[4], &[1.0, 1.0, 2.0, 2.0]);
        let nearest = [
            ("mode", AttributeValue::Text("nearest")),
            (
                "coordinate_transformation_mode",
                AttributeValue::Text("asymmetric"),
            ),
            ("nearest_mode", AttributeValue::Text("floor")),
        ];
        let region = Value(String::new());
        let doubled = self.node("Resize", &name("doubled"), &[x, &region, &scales], &nearest);
        self.concat(&name("appended"), &[&doubled, skip])
    }
}
