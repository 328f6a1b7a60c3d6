// The message is only sent and received in its serialised form; see ../../README.md.
#pragma once

namespace rosrm_msgs::msg
{

struct Sealed {};

}  // namespace rosrm_msgs::msg
