#include "front.h"

volatile layout::Front front = {};
